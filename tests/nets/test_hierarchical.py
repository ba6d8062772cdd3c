"""The hierarchical net; see test_contract for what all nets guarantee."""

from functools import partial
from typing import Any

import pytest
import torch
from torch.testing import assert_close

import mops_lightning as mops
from mops_lightning.config.build import build
from mops_lightning.config.compose import compose
from mops_lightning.errors import UserError
from mops_lightning.nets.hierarchical import (
    HierarchicalNet,
    HierarchicalSegmentation,
    Stage,
    carried,
)
from mops_lightning.ops.points import gather_points
from mops_lightning.ops.propagation import interpolate
from mops_lightning.tasks.classification import Classification
from mops_lightning.tasks.segmentation import Segmentation
from mops_lightning.types import Batch

SAMPLERS: tuple[Any, ...] = (
    mops.FPSSampler,
    mops.RandomSampler,
    mops.SerialSampler,
    mops.VoxelSampler,
    mops.SNet,
    mops.SampleNet,
    mops.GumbelSampler,
    mops.CriticalSampler,
    mops.MOPSNet,
    partial(mops.MOPSNet, anchors="fps"),
    partial(mops.FMOPSNet, num_sizes=1),
)


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_stages_train_any_sampler(sampler, randn):
    net: Any = HierarchicalNet(5, sampler, (20, 8), (8, 16, 16), 4)
    points = randn(4, 40, 3)

    logits = net(points)
    loss = logits.square().sum() + sum(net.losses.values())
    loss.backward()

    assert logits.shape == (4, 5)
    for stage in net.stages:
        assert stage.sampler.m in (20, 8)
        for weights in stage.sampler.parameters():
            assert weights.grad is not None


def sizes_of_levels(net, points):
    return [level.shape[1] for level, _ in net.levels(points)]


def test_fmops_by_name_draws_a_size_for_every_step(randn):
    cfg = compose(
        [
            "task/net=hierarchical",
            "sampler@task.net.sampler=fmops",
            "task.net.points=[32,16,8,4]",
        ]
    )
    net: Any = build(cfg.task.net, "task.net", num_classes=5)
    points = randn(4, 40, 3)

    sizes_of_steps = []
    for _ in range(9):
        _, *sizes = sizes_of_levels(net, points)
        sizes_of_steps.append(sizes)
    of_few_points = sizes_of_levels(net.eval(), points[:, :10])

    most = torch.tensor([32, 16, 8, 4])
    drawn = torch.tensor(sizes_of_steps)
    powers = drawn.log() / most.log()
    assert powers.min() >= 0.5  # 2 = 4^0.5 is the integer part of 4^0.75
    assert powers.max() <= 1
    assert powers.min() < powers.max()
    assert of_few_points == [10, 10, 10, 8, 4]


def plain_offsets(centres, points, rows):
    """Return the offsets of neighbours, divided by their root mean square in each cloud."""
    offsets = gather_points(points, rows) - centres[:, :, None]
    mean_squares = offsets.square().sum(3).mean((1, 2))
    return offsets / mean_squares.sqrt()[:, None, None, None]


def plain_moments(offsets):
    """Return the means of offsets and of their products."""
    products = torch.einsum("bmki,bmkj->bmkij", offsets, offsets)
    second = products.mean(2).flatten(2)
    return torch.cat([offsets.mean(2), second], 2)


def plain_stage(stage, points, features):
    """All edges (f_j, p_j − q_i) as one tensor."""
    output = stage.sampler(points)
    centres = output.points
    near = torch.cdist(centres, points).topk(stage.k, largest=False).indices
    offsets = plain_offsets(centres, points, near)
    neighbours = gather_points(features, near)
    edges = stage.feature(neighbours) + stage.offset(offsets)
    if output.indices is None:
        own = output.matrix.dense().mT @ features
    else:
        own = gather_points(features, output.indices)
    moments = stage.moments(plain_moments(offsets))
    centre = stage.centre(own) + moments
    largest = (edges + centre[:, :, None]).amax(2)
    normed = stage.norm(largest.flatten(0, 1)).relu()
    mixed = normed.unflatten(0, centres.shape[:2])
    return centres, mixed + stage.mlp(mixed)


def gradients_of(forward, stage, points, features):
    """Return what a form of a stage gives, and its gradients in one direction."""
    centres, found = forward(points, features)
    direction = torch.linspace(-1, 1, found.numel()).view_as(found)
    inputs = [points, features, stage.offset.weight]
    gradients = torch.autograd.grad(found, inputs, direction)
    return centres, found, *gradients


@pytest.mark.parametrize("sampler", [mops.FPSSampler, mops.MOPSNet])
def test_stage_equals_maximum_over_explicit_edges(sampler, randn):
    stage = Stage(sampler(m=7), 7, 6, 10, 4).eval()
    points = randn(2, 30, 3).requires_grad_()
    features = randn(2, 30, 6).requires_grad_()

    fast = gradients_of(stage, stage, points, features)
    plain = gradients_of(partial(plain_stage, stage), stage, points, features)

    assert_close(fast, plain, atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize("sampler", [mops.FPSSampler, mops.MOPSNet])
def test_stage_of_equal_points_has_finite_gradients(sampler, randn):
    stage = Stage(sampler(m=7), 7, 6, 10, 4).eval()
    points = torch.zeros(2, 30, 3, requires_grad=True)
    features = randn(2, 30, 6)

    _, found = stage(points, features)
    found.sum().backward()

    assert points.grad is not None
    assert points.grad.isfinite().all()


def test_points_without_matrix_carry_the_feature_of_the_nearest_point(randn):
    points = randn(2, 30, 3)
    features = randn(2, 30, 6)
    output = mops.SNet(m=5).eval()(points)

    found = carried(output, points, features)

    nearest = torch.cdist(output.points, points).argmin(2)
    assert_close(found, gather_points(features, nearest))


def test_stage_of_fewer_points_than_its_sampler_returns_is_refused(randn):
    points = randn(2, 4, 3)
    features = randn(2, 4, 6)
    stage = Stage(mops.SNet(m=5), 5, 6, 10, 4)

    with pytest.raises(UserError, match=r"task\.net\.points .* 4 points .* SNet returns 5"):
        stage(points, features)


@pytest.mark.parametrize("kind", [mops.MOPSNet, mops.StageMOPSNet])
@pytest.mark.parametrize(
    ("make_net", "make_task"),
    [
        (HierarchicalNet, Classification),
        (HierarchicalSegmentation, Segmentation),
    ],
)
def test_losses_of_stages_are_part_of_the_step(make_net, make_task, kind, randn):
    torch.manual_seed(0)
    sampler = partial(kind, alpha=2.0)
    net = make_net(5, sampler, (20, 8), (8, 16, 16), 4)
    task = make_task(net, 5)
    points = randn(4, 40, 3)
    parts = torch.zeros(4, 40, dtype=torch.int64)
    batch = Batch(points, torch.tensor([0, 1, 2, 3]), None, parts)

    losses = task.step(batch, points).losses
    losses_in_test = task.eval().step(batch, points).losses

    assert sorted(losses) == ["cross_entropy", "stage1_subset", "stage2_subset"]
    assert losses["stage1_subset"] > 0
    assert sorted(losses_in_test) == ["cross_entropy"]


def test_segmentation_goes_back_through_the_levels_with_the_whole_cloud_at_the_deepest(randn):
    net: Any = HierarchicalSegmentation(5, mops.FPSSampler, (20, 8), (8, 16, 24), 4).eval()
    points = randn(2, 40, 3)

    logits = net(points)

    (_, of_input), (of_20, features_of_20), (of_8, features_of_8) = net.levels(points)
    whole_cloud = features_of_8.amax(1, keepdim=True).expand(2, 8, 24)
    deepest = torch.cat([features_of_8, whole_cloud], 2)
    to_20, to_input = net.back
    carried_to_20 = interpolate(deepest, of_8, of_20, k=3)
    back_at_20 = to_20(torch.cat([carried_to_20, features_of_20], 2))
    carried_to_input = interpolate(back_at_20, of_20, points, k=3)
    back_at_input = to_input(torch.cat([carried_to_input, of_input], 2))
    assert_close(logits, net.head(back_at_input))


def test_classifier_sees_the_peaks_of_all_stages_and_the_mean_of_the_last(randn):
    net: Any = HierarchicalNet(5, mops.FPSSampler, (20, 8), (8, 16, 24), 4).eval()
    points = randn(2, 40, 3)

    logits = net(points)

    _, (_, features_of_20), (_, features_of_8) = net.levels(points)
    seen = [features_of_20.amax(1), features_of_8.amax(1), features_of_8.mean(1)]
    assert_close(logits, net.head(torch.cat(seen, 1)))
