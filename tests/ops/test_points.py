import numpy as np
import pytest
import torch
from torch.testing import assert_close

from mops_lightning.errors import UserError
from mops_lightning.ops.points import (
    UnitSphere,
    as_tensor,
    gather_points,
    normalize_unit_sphere,
)

COMPLEX = np.array([[1 + 2j, 3, 4]])


@pytest.mark.parametrize("points", [COMPLEX, torch.from_numpy(COMPLEX)])
def test_as_tensor_refuses_complex_numbers(points):
    with pytest.raises(UserError, match=r"points must hold real numbers, got torch\.complex128"):
        as_tensor("points", points)


def test_gather_points_equals_double_loop(rng, randn):
    points = randn(2, 7, 4, dtype=torch.float64)
    indices = torch.randint(7, (2, 5), generator=rng)

    gathered = gather_points(points, indices)

    for cloud in range(2):
        for place, row in enumerate(indices[cloud].tolist()):
            assert torch.equal(gathered[cloud, place], points[cloud, row])


def test_gather_points_of_nested_indices_equals_that_of_flat_ones(rng, randn):
    points = randn(2, 7, 4, dtype=torch.float64)
    indices = torch.randint(7, (2, 2, 2), generator=rng)

    gathered = gather_points(points, indices)

    flat = gather_points(points, indices.flatten(1))
    assert torch.equal(gathered, flat.unflatten(1, (2, 2)))


def test_gather_points_has_gradients(rng, randn):
    points = randn(2, 7, 4, dtype=torch.float64, requires_grad=True)
    indices = torch.randint(7, (2, 5), generator=rng)

    def gathered(points):
        return gather_points(points, indices)

    assert torch.autograd.gradcheck(gathered, (points,))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_normalize_centres_and_scales(dtype, randn):
    points = 5 + 3 * randn(4, 20, 3, dtype=dtype)

    result = normalize_unit_sphere(points)

    means = result.mean(1)
    radii = result.norm(dim=2).amax(1)
    assert result.dtype == dtype
    assert means.abs().max() < 1e-6
    assert radii.tolist() == pytest.approx([1, 1, 1, 1])
    # All differences between points have one ratio in a cloud.
    ratios = points.diff(dim=1) / result.diff(dim=1)
    ratio_of_cloud = ratios[:, :1, :1].expand_as(ratios)
    assert_close(ratios, ratio_of_cloud, rtol=1e-3, atol=0)


@pytest.mark.parametrize("number", [10, 100, 1000])
def test_normalize_of_coincident_points_is_zero(number, randn):
    points = torch.full((2, number, 3), 0.7)  # most of these means are not 0.7
    points[1] = randn(number, 3)
    points.requires_grad_()

    result = normalize_unit_sphere(points)

    (gradient,) = torch.autograd.grad(result.square().sum(), points)
    assert (result[0] == 0).all()
    assert torch.isfinite(gradient).all()


def test_unit_sphere_of_equal_points_has_radius_one():
    points = np.full((5, 3), 7.0)

    sphere = UnitSphere.around(points)

    assert sphere.radius == 1.0
    assert (sphere.normalise(points) == 0).all()


@pytest.mark.parametrize("farthest", [0, 20_000, 39_999])
def test_unit_sphere_of_a_large_cloud_reaches_its_farthest_point_wherever_it_is(farthest):
    points = np.random.default_rng(0).uniform(-1, 1, (40_000, 3))
    points += (500_000, 4_500_000, 100)
    points[farthest] += 30

    sphere = UnitSphere.around(points)

    unit = sphere.normalise(points)
    restored = sphere.restore(unit)
    lengths = np.linalg.norm(unit, axis=1)
    assert lengths.argmax() == farthest
    assert lengths.max() == pytest.approx(1.0)
    assert np.abs(restored - points).max() < 1e-5
