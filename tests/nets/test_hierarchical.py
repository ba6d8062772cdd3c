"""The hierarchical net; see test_contract for what all nets guarantee."""

from functools import partial
from typing import Any

import pytest
import torch

import mops_lightning as mops
from mops_lightning.config.build import build
from mops_lightning.config.compose import compose
from mops_lightning.errors import UserError
from mops_lightning.nets.hierarchical import HierarchicalNet, Stage, carried
from mops_lightning.tasks.classification import Classification
from mops_lightning.types import Batch

SAMPLERS: tuple[Any, ...] = (
    *(mops.FPSSampler, mops.RandomSampler, mops.SerialSampler, mops.VoxelSampler),
    *(mops.SNet, mops.SampleNet, mops.GumbelSampler, mops.CriticalSampler, mops.MOPSNet),
    *(partial(mops.MOPSNet, anchors="fps"), partial(mops.FMOPSNet, num_sizes=1)),
)


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_stages_train_any_sampler(sampler, rng):
    net: Any = HierarchicalNet(5, sampler, (20, 8), (8, 16, 16), 4)
    logits = net(torch.randn(4, 40, 3, generator=rng))
    assert logits.shape == (4, 5)
    (logits.square().sum() + sum(net.losses.values())).backward()
    for stage in net.stages:
        assert stage.sampler.m in (20, 8)
        assert all(p.grad is not None for p in stage.sampler.parameters())


def test_fmops_by_name_draws_a_size_for_every_step(rng):
    chosen = "task/net=hierarchical sampler@task.net.sampler=fmops task.net.points=[32,16,8,4]"
    net: Any = build(compose(chosen.split()).task.net, "task.net", num_classes=5)
    points = torch.randn(4, 40, 3, generator=rng)
    drawn = [[p.shape[1] for p, _ in net.levels(points)[1:]] for _ in range(9)]
    powers = torch.tensor(drawn).log() / torch.tensor([32, 16, 8, 4]).log()
    assert 0.5 <= powers.min() < powers.max() <= 1  # 2 = 4^0.5 is the integer part of 4^0.75
    assert [p.shape[1] for p, _ in net.eval().levels(points[:, :10])] == [10, 10, 10, 8, 4]


def plain_stage(stage, points, features):
    """All edges (f_j, p_j − q_i) as one tensor."""
    output = stage.sampler(points)
    centres = output.points
    near = torch.cdist(centres, points).topk(stage.k, largest=False).indices
    cloud = torch.arange(len(points))[:, None, None]
    offsets = points[cloud, near] - centres[:, :, None]
    r = offsets.square().sum(3).mean((1, 2)).sqrt()[:, None, None, None]
    edges = stage.feature(features[cloud, near]) + stage.offset(offsets / r)
    if output.indices is None:
        own = output.matrix.dense().mT @ features
    else:
        own = features[cloud[:, 0], output.indices]
    offsets = offsets / r
    products = torch.einsum("bmki,bmkj->bmkij", offsets, offsets).mean(2).flatten(2)
    moments = stage.moments(torch.cat([offsets.mean(2), products], 2))
    mixed = (edges + (stage.centre(own) + moments)[:, :, None]).amax(2)
    mixed = stage.norm(mixed.flatten(0, 1)).relu().unflatten(0, centres.shape[:2])
    return centres, mixed + stage.mlp(mixed)


@pytest.mark.parametrize("sampler", [mops.FPSSampler, mops.MOPSNet])
def test_stage_equals_maximum_over_explicit_edges(sampler, rng):
    stage = Stage(sampler(m=7), 7, 6, 10, 4).eval()
    given = [torch.randn(2, 30, c, generator=rng).requires_grad_() for c in (3, 6)]
    results = []
    for forward in (stage, partial(plain_stage, stage)):
        centres, found = forward(*given)
        total = (found * torch.linspace(-1, 1, found.numel()).view_as(found)).sum()
        results.append([centres, found, *torch.autograd.grad(total, [*given, stage.offset.weight])])
    for ours, twin in zip(*results, strict=True):
        torch.testing.assert_close(ours, twin, atol=1e-4, rtol=1e-3)
    points = torch.zeros_like(given[0]).requires_grad_()
    stage(points, given[1])[1].sum().backward()
    assert points.grad is not None
    assert points.grad.isfinite().all()


def test_points_without_matrix_carry_the_feature_of_the_nearest_point(rng):
    points, features = (torch.randn(2, 30, c, generator=rng) for c in (3, 6))
    output = mops.SNet(m=5).eval()(points)
    near = torch.cdist(output.points, points).argmin(2)
    expected = features[torch.arange(2)[:, None], near]
    torch.testing.assert_close(carried(output, points, features), expected)
    with pytest.raises(UserError, match=r"task\.net\.points .* 4 points .* SNet returns 5"):
        Stage(mops.SNet(m=5), 5, features.shape[2], 10, 4)(points[:, :4], features[:, :4])


def test_losses_of_stages_are_part_of_the_step(rng):
    torch.manual_seed(0)
    net = HierarchicalNet(5, partial(mops.MOPSNet, alpha=2.0), (20, 8), (8, 16, 16), 4)
    task = Classification(net, 5)
    points = torch.randn(4, 40, 3, generator=rng)
    batch = Batch(points, torch.tensor([0, 1, 2, 3]))
    losses = task.step(batch, points).losses
    assert sorted(losses) == ["cross_entropy", "stage1_subset", "stage2_subset"]
    assert losses["stage1_subset"] > 0
    assert sorted(task.eval().step(batch, points).losses) == ["cross_entropy"]
