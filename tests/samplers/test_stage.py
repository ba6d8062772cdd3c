"""MOPS-Net on the features of a hierarchical net."""

from functools import partial

import pytest
import torch

from mops_lightning import StageMOPSNet
from mops_lightning.errors import UserError
from mops_lightning.nets.hierarchical import HierarchicalNet
from mops_lightning.ops.fps import farthest_point_sample
from mops_lightning.ops.points import gather_points


def moved(net):
    for weights in net.queries.parameters():
        torch.nn.init.normal_(weights, std=0.5)
    return net


@pytest.mark.parametrize("candidates", [None, 3])
def test_stage_sampler_equals_a_dense_softmax_over_the_host_features(candidates, rng):
    net = moved(StageMOPSNet(5, 7, key_channels=16, candidates=candidates, neighbours=6)).double()
    points = torch.randn(1, 60, 3, dtype=torch.float64, generator=rng)
    features = torch.randn(1, 60, 7, dtype=torch.float64, generator=rng, requires_grad=True)
    start = (points - points.mean(1, keepdim=True)).norm(dim=2).argmax(1)
    order = farthest_point_sample(points, 60, start)[0]
    rows = order if candidates is None else order[: 3 * 5]
    near = torch.cdist(points[0, order[:5]], points[0, rows]).argsort(1)[:, :6]

    output = net.by_features(points, features, 5)

    local = features[0, rows]
    hidden = net.rho_local(local) + net.rho_global(local.amax(0))
    keys = net.rho_first(hidden)
    chosen = points[0, order[:60]]
    unit = (chosen[:-1] - chosen[-1]).square().sum(1).amin() * 60 / 64
    logits = keys @ (net.queries.slots + keys[:5] @ net.queries.relation.T / 4).T
    squares = torch.cdist(points[0, rows], points[0, order[:5]]).square()
    logits = logits - squares / (unit * net.queries.log_width.exp().square())
    outside = torch.ones_like(logits, dtype=torch.bool).scatter(0, near.T, False)
    want = logits.masked_fill(outside, -torch.inf).softmax(0).T @ points[0, rows]
    torch.testing.assert_close(output.points[0], want)
    (got,) = torch.autograd.grad(output.points.square().sum(), features, retain_graph=True)
    torch.testing.assert_close(got, torch.autograd.grad(want.square().sum(), features)[0])
    assert set(output.losses) == {"subset"}


def test_hierarchical_net_trains_its_stages_through_the_host_features(rng):
    sampler = partial(StageMOPSNet, alpha=1.0, neighbours=4, overlap=0.1)
    net = HierarchicalNet(3, sampler, points=(12, 6), channels=(8, 10, 12), k=4, hidden=8)
    points = torch.randn(4, 40, 3, generator=rng)

    logits = net(points)
    (logits.square().mean() + sum(net.losses.values())).backward()

    assert logits.shape == (4, 3)
    names = {f"stage{i}_{name}" for i in (1, 2) for name in ("subset", "overlap")}
    assert set(net.losses) == names
    for name, weights in net.named_parameters():
        assert weights.grad is not None, name
        assert weights.grad.isfinite().all(), name
    assert not any(name.endswith("sampler.features") for name, _ in net.named_modules())


def test_stage_sampler_takes_clouds_with_fewer_points(rng):
    sampler = partial(StageMOPSNet, neighbours=4)
    net = HierarchicalNet(3, sampler, points=(12, 6), channels=(8, 10, 12), k=4, hidden=8).eval()

    assert net(torch.randn(2, 5, 3, generator=rng)).shape == (2, 3)


def test_stage_sampler_starts_near_farthest_points(rng):
    net = StageMOPSNet(50, 4).eval()
    points = torch.nn.functional.normalize(torch.randn(2, 1000, 3, generator=rng), dim=2)
    start = (points - points.mean(1, keepdim=True)).norm(dim=2).argmax(1)
    anchors = gather_points(points, farthest_point_sample(points, 50, start))

    generated = net.by_features(points, torch.randn(2, 1000, 4, generator=rng), 50).points

    assert (generated - anchors).norm(dim=2).max() < 0.2


def test_stage_sampler_outside_a_net_is_refused(rng):
    with pytest.raises(UserError, match=r"inside a hierarchical net only.*sampler=mops"):
        StageMOPSNet(5, 7).eval()(torch.randn(1, 60, 3, generator=rng))
