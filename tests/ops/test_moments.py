"""Moments of neighbourhoods against gathered offsets."""

import torch
from torch.testing import assert_close

from mops_lightning.ops.moments import neighbourhood_moments
from mops_lightning.ops.points import gather_points


def test_neighbourhood_moments_equal_those_of_gathered_offsets_and_so_do_their_gradients(
    rng, randn
):
    points = randn(2, 9, 3, dtype=torch.float64, requires_grad=True)
    centres = randn(2, 5, 3, dtype=torch.float64, requires_grad=True)
    rows = torch.randint(9, (2, 5, 4), generator=rng)  # some repeat

    def moments_of(points, centres):
        return neighbourhood_moments(points, centres, rows)

    moments = moments_of(points, centres)

    offsets = gather_points(points, rows) - centres[:, :, None]
    products = offsets[..., :, None] * offsets[..., None, :]
    assert_close(moments[..., :3], offsets.mean(2))
    assert_close(moments[..., 3:], products.mean(2).flatten(2))
    assert torch.autograd.gradcheck(moments_of, (points, centres))


def test_neighbourhood_moments_of_fixed_points_have_the_same_gradients_of_centres(rng, randn):
    points = randn(2, 9, 3)
    centres = randn(2, 5, 3, requires_grad=True)
    rows = torch.randint(9, (2, 5, 4), generator=rng)
    given = randn(2, 5, 12)
    moved = points.clone().requires_grad_()
    moments = neighbourhood_moments(moved, centres, rows)
    expected, _ = torch.autograd.grad(moments, (centres, moved), given)

    moments = neighbourhood_moments(points, centres, rows)

    (gradient,) = torch.autograd.grad(moments, centres, given)
    assert gradient.equal(expected)


def test_neighbourhood_moments_of_half_precision_are_near_those_in_single(rng, randn):
    points = randn(2, 9, 3)
    rows = torch.randint(9, (2, 5, 4), generator=rng)
    in_half = points.bfloat16()

    moments = neighbourhood_moments(in_half, in_half[:, :5], rows)

    expected = neighbourhood_moments(points, points[:, :5], rows)
    assert moments.dtype == torch.bfloat16
    assert_close(moments.float(), expected, atol=0.1, rtol=0.1)
