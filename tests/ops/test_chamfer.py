"""The chamfer distance against its plain form, SciPy's KD-tree and finite differences."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from mops_lightning.ops.nearest import chamfer_distance


def pair(kind, rng):
    points = torch.randn(3, 60, 3, generator=rng, dtype=torch.float64)
    others = torch.randn(3, 45, 3, generator=rng, dtype=torch.float64)
    if kind == "one point":
        points, others = points[:, :1], others[:, :1]
    if kind == "tiny":
        points, others = points * 1e-9, others * 1e-9
    if kind == "coincident":
        points, others = points[:, :1].expand(-1, 60, -1), others[:, :1].expand(-1, 45, -1)
    if kind == "repeated":
        others = points[:, torch.arange(45) % 7]
    if kind == "line":
        points, others = (cloud * torch.tensor([1.0, 0.0, 0.0]) for cloud in (points, others))
    if kind == "plane":
        points, others = (cloud * torch.tensor([1.0, 1.0, 0.0]) for cloud in (points, others))
    return points, others


@pytest.mark.parametrize(
    "kind", ["random", "one point", "tiny", "coincident", "repeated", "line", "plane"]
)
def test_chamfer_equals_scipy(kind, rng):
    points, others = pair(kind, rng)
    want = []
    for ours, theirs in zip(points.numpy(), others.numpy(), strict=True):
        there, back = cKDTree(theirs).query(ours)[0], cKDTree(ours).query(theirs)[0]
        want.append(np.square(there).mean() + np.square(back).mean())
    torch.testing.assert_close(
        chamfer_distance(points, others), torch.tensor(want), rtol=1e-10, atol=1e-28
    )


@pytest.mark.parametrize("kind", ["coincident", "repeated", "line"])
def test_chamfer_degenerate_clouds_have_finite_gradients(kind, rng):
    leaves = [cloud.clone().requires_grad_() for cloud in pair(kind, rng)]
    for gradient in torch.autograd.grad(chamfer_distance(*leaves).sum(), leaves):
        assert gradient.isfinite().all()


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
