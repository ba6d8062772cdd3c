"""The chamfer distance against its plain form."""

import pytest
import torch

from mops_lightning.ops.nearest import chamfer_distance


def plain_chamfer(points, others):
    squares = (points[:, :, None] - others[:, None]).square().sum(-1)
    return squares.min(2).values.mean(1) + squares.min(1).values.mean(1)


@pytest.mark.parametrize(("n", "m"), [(1, 1), (1, 7), (40, 25), (300, 900)])
def test_chamfer_equals_plain_form(n, m, rng):
    points = torch.randn(3, n, 3, dtype=torch.float64, generator=rng, requires_grad=True)
    others = torch.randn(3, m, 3, dtype=torch.float64, generator=rng, requires_grad=True)
    got, want = chamfer_distance(points, others), plain_chamfer(points, others)
    torch.testing.assert_close(got, want)
    gradients = [torch.autograd.grad(value.sum(), [points, others]) for value in (got, want)]
    torch.testing.assert_close(*gradients)
