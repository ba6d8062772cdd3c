import numpy as np
import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.ops.farthest import squared_factors
from mops_lightning.ops.fps import farthest_point_fill, farthest_point_sample
from tests.support.plain import plain_farthest


@pytest.mark.usefixtures("farthest_form")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("n", "m"),
    [
        (1, 1),
        (20, 20),
        (32, 7),
        (75, 30),
    ],
)
def test_fps_equals_double_loop(n, m, dtype, rng, randn):
    points = randn(3, n, 3, dtype=dtype)
    start = torch.randint(n, (3,), generator=rng)

    indices = farthest_point_sample(points, m, start=start)

    assert indices.dtype == torch.int64
    for cloud, first, chosen in zip(points, start.tolist(), indices, strict=True):
        expected = plain_farthest(cloud, [first], m)
        assert chosen.tolist() == expected


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize(
    ("n", "m"),
    [
        (1, 1),
        (37, 37),
        (1024, 512),
        (10_000, 40),
        (20_000, 9),
    ],
)
@pytest.mark.parametrize("grid", [False, True])  # a grid has many ties and copies
def test_fps_on_a_gpu_is_that_of_a_cpu(n, m, grid, rng, randn):
    points = randn(3, n, 3)
    if grid:
        points = (4 * points).round()
    start = torch.randint(n, (3,), generator=rng)

    on_gpu = farthest_point_sample(points.cuda(), m, start.cuda())

    on_cpu = farthest_point_sample(points, m, start)
    assert torch.equal(on_gpu.cpu(), on_cpu)


@pytest.mark.usefixtures("farthest_form")
@pytest.mark.parametrize(
    ("n", "m"),
    [
        (1, 1),
        (20, 20),
        (75, 30),
        (3000, 9),
    ],
)
def test_fps_multiplies_distances_by_weights(n, m, randn, rand):
    points = randn(3, n, 3, dtype=torch.float64)
    weight = rand(3, n).square() * 100
    without_weight = n // 4
    weight[:, :without_weight] = 0  # these are the last
    number = min(m, n - without_weight)

    indices = farthest_point_sample(points, m, n - 1, weight)

    for row, chosen in enumerate(indices.tolist()):
        expected = plain_farthest(points[row], [n - 1], number, weight[row])
        assert chosen[:number] == expected
        assert len(set(chosen)) == m


def test_fps_equal_weights_change_nothing(rng):
    points = torch.randint(0, 9, (2, 5000, 3), generator=rng).float()  # many ties and copies
    weight = torch.full((2, 5000), 0.3)

    weighted = farthest_point_sample(points, 400, weight=weight)

    unweighted = farthest_point_sample(points, 400)
    assert torch.equal(weighted, unweighted)


def test_fps_start_is_given_or_zero(randn):
    points = randn(4, 30, 3)

    from_seven = farthest_point_sample(points, 3, start=7)
    by_default = farthest_point_sample(points, 3)

    assert from_seven[:, 0].tolist() == [7, 7, 7, 7]
    assert by_default[:, 0].tolist() == [0, 0, 0, 0]


@pytest.mark.usefixtures("farthest_form")
def test_fps_of_coincident_points_is_distinct():
    points = torch.zeros(2, 40, 3)
    points[1, 10:20] = 1.0

    indices = farthest_point_sample(points, 40, start=3)

    every_row = list(range(40))
    first, second = indices.tolist()
    assert sorted(first) == every_row
    assert sorted(second) == every_row
    assert second[1] == 10  # the lowest of the farthest


@pytest.mark.parametrize(
    ("m", "start", "said"),
    [
        (0, 0, "m must be"),
        (6, 0, "m must be"),
        (2, 5, "start must be"),
        (2, -1, "start must be"),
    ],
)
def test_fps_out_of_range_raises(m, start, said):
    points = torch.zeros(1, 5, 3)

    with pytest.raises(UserError, match=said):
        farthest_point_sample(points, m, start=start)


def test_fps_single_cloud_raises():
    with pytest.raises(UserError, match=r"points must have shape \(B, N, C\), got \(5, 3\)"):
        farthest_point_sample(torch.zeros(5, 3), 2)


@pytest.mark.usefixtures("farthest_form")
def test_fill_equals_double_loop(randn, rand):
    points = randn(3, 45, 3)
    given = torch.tensor([1, 6, 12])
    indices = rand(3, 45).argsort(1)[:, :12]

    filled = farthest_point_fill(points, indices, given)

    for cloud in range(3):
        chosen = indices[cloud, : given[cloud]].tolist()
        expected = plain_farthest(points[cloud], chosen, 12)
        assert filled[cloud].tolist() == expected


def test_fill_of_points_with_gradients_equals_fill_without(randn):
    points = randn(2, 40, 3)
    points_with_gradients = points.clone().requires_grad_()
    indices = torch.arange(10).expand(2, -1)
    given = torch.tensor([2, 5])

    filled = farthest_point_fill(points_with_gradients, indices, given)

    expected = farthest_point_fill(points, indices, given)
    assert torch.equal(filled, expected)


def test_fps_weights_multiply_distances_not_their_squares():
    points = torch.tensor([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]])
    weight = torch.tensor([[1.0, 3.0, 1.0]])  # 3 · 1 > 1 · 2, but 3 · 1² < 1 · 2²
    start = torch.tensor([0])

    rows = farthest_point_sample(points, 2, start, weight=weight)

    assert rows.tolist() == [[0, 1]]


def test_factors_of_squared_distances_are_as_squared_weights():
    weight = np.array([[1.0, 3.0, 2.0]])

    factors = squared_factors(weight)

    ratios = factors / factors[:, :1]
    np.testing.assert_allclose(ratios, [[1.0, 9.0, 4.0]], rtol=1e-12)
