"""Segmentation: parts of all points from the sampled ones; see test_contract for all tasks."""

from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional as F

from mops_lightning.data import cloud_folder as folder
from mops_lightning.data.formats.registry import WRITERS
from mops_lightning.data.formats.table import Table
from mops_lightning.data.shapes import PARTS, shapes
from mops_lightning.errors import UserError
from mops_lightning.nets.hierarchical import HierarchicalSegmentation
from mops_lightning.ops.propagation import interpolate
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.tasks.segmentation import Segmentation
from mops_lightning.types import UNKNOWN, Batch

cloud_folder = partial(
    folder.cloud_folder, test_frames=None, crop="whole", crops=2, n_points=20, label="kind"
)


class Halves(nn.Module):
    """Knows the sign of x."""

    def forward(self, points):
        return torch.stack([-points[..., 0], points[..., 0]], 2) * 50


def test_interpolation_equals_plain_loops(rng):
    values = torch.rand(2, 6, 4, generator=rng)
    points = torch.rand(2, 6, 3, generator=rng)
    queries = torch.rand(2, 9, 3, generator=rng)
    found = interpolate(values, points, queries)
    for cloud in range(2):
        for query, row in zip(queries[cloud], found[cloud], strict=True):
            squared = (points[cloud] - query).square().sum(1)
            near = squared.argsort()[:3]
            weights = 1 / squared[near]
            expected = (values[cloud, near] * weights[:, None]).sum(0) / weights.sum()
            torch.testing.assert_close(row, expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(interpolate(values, points, points), values, rtol=1e-4, atol=1e-4)
    assert interpolate(values[:, :1], points[:, :1], queries).shape == (2, 9, 4)
    given = [one[:1].double().requires_grad_() for one in (values, points, queries)]
    assert torch.autograd.gradcheck(interpolate, given)


def test_all_points_are_scored_from_few(rng):
    points = torch.randn(3, 200, 3, generator=rng)
    parts = points[..., 0].gt(0).long()
    task = Segmentation(Halves(), 2)
    batch = Batch(points, torch.zeros(3, dtype=torch.int64), parts=parts)
    few = task.step(batch, points[:, :25])
    assert few.predictions.shape == few.targets.shape == (3, 200)
    right = few.predictions.eq(parts).float().mean()
    assert 0.7 < right < 1
    losses = {n: task.step(batch, points[:, :n]).losses["cross_entropy"].item() for n in (25, 200)}
    assert losses[200] < losses[25]
    same = task.predict(batch, points)
    copy = task.predict(batch, points.clone())
    torch.testing.assert_close(same, copy, atol=1e-2, rtol=1e-4)
    metrics = task.metrics()
    metrics.update(few.predictions, few.targets)
    values = metrics.compute()
    assert values["point_accuracy"] == pytest.approx(right.item())
    both = [(few.predictions == k) & (parts == k) for k in (0, 1)]
    either = [(few.predictions == k) | (parts == k) for k in (0, 1)]
    ious = [(a.sum() / b.sum()).item() for a, b in zip(both, either, strict=True)]
    assert values["mean_iou"] == pytest.approx(sum(ious) / 2, abs=1e-6)
    with pytest.raises(UserError, match="needs clouds whose points have parts"):
        task.step(batch._replace(parts=None), points)
    with pytest.raises(UserError, match=r"num_parts must be at least 2, got 1\."):
        Segmentation(Halves(), 1)


def test_points_of_unknown_part_are_neither_learned_nor_scored(rng):
    points = torch.randn(2, 99, 3, generator=rng)
    known = torch.rand(2, 99, generator=rng) > 0.3
    task = Segmentation(Halves(), 2)
    parts = (points[..., 1] > 0).long()
    batch = Batch(points, torch.zeros(2).long(), parts=parts.where(known, UNKNOWN))
    found = task.step(batch, points)
    loss = F.cross_entropy(task.predict(batch, points)[known], parts[known])
    torch.testing.assert_close(found.losses["cross_entropy"], loss)
    scores = task.metrics()(found.predictions, found.targets)
    assert scores == task.metrics()(found.predictions[known], parts[known])
    none = task.step(batch._replace(parts=torch.full_like(parts, UNKNOWN)), points)
    assert none.losses["cross_entropy"] == 0


def test_net_follows_order_of_points(rng):
    net = HierarchicalSegmentation(5, FPSSampler, (20, 8), (8, 16, 16), 4).eval()
    points = torch.randn(2, 40, 3, generator=rng)
    order = torch.randperm(40, generator=rng)
    found = net(points)
    assert found.shape == (2, 40, 5)
    torch.testing.assert_close(net(points[:, order]), found[:, order], atol=1e-4, rtol=1e-4)
    assert net(points[:, :3]).shape == (2, 3, 5)
    net.train()(points).square().sum().backward()
    assert all(p.grad is not None for p in net.parameters())


def test_shapes_know_their_parts(tmp_path):
    make = partial(shapes, n_points=256, train_per_class=12, test_per_class=2, cache=tmp_path)
    data = make(classes="parts")
    train: Any = data.train
    for label, name in enumerate(data.class_names):
        found = train.parts[train.labels == label].unique()
        assert {data.part_names[part] for part in found} <= set(PARTS[name])
    seat, leg = (data.part_names.index(name) for name in ("seat", "leg"))
    for cloud, parts in zip(train.points, train.parts, strict=True):
        if (parts == seat).any():
            height = cloud[:, 1]
            assert height[parts == leg].mean() < height[parts == seat].mean()
    again: Any = make(classes="parts").train  # from the cache
    alone = make(classes=["chair"])
    assert torch.equal(again.parts, train.parts)
    assert alone.part_names == PARTS["chair"]
    rows = train.labels == data.class_names.index("chair")
    assert torch.equal(alone.train.points, train.points[rows])
    assert train.take(rows).parts.shape == (12, 256)
    assert make(classes=["chair", "sofa"]).part_names == ()


@pytest.mark.parametrize("suffix", [".ply", ".npz"])
def test_scans_have_parts_of_their_own(suffix, tmp_path, rng):
    for number, kinds in enumerate(([7, 2], [2, 40])):
        points = torch.rand(60, 3, generator=rng).double().numpy()
        kind = np.where(points[:, 0] > 0.5, *kinds).astype(np.int16)
        kind[::4] = -1 - number
        WRITERS[suffix](tmp_path / f"scan{number}{suffix}", Table(points, {"kind": kind}))
    data = cloud_folder(tmp_path)
    assert data.part_names == ("2", "7", "40")
    splits: list[Any] = [data.train, data.test]
    for clouds in splits:
        for cloud, parts in zip(clouds.points, clouds.parts, strict=True):
            unknown, low, high = parts.unique().tolist()
            assert unknown == UNKNOWN
            right = parts == high
            sides = cloud[right, 0].mean() - cloud[parts == low, 0].mean()
            assert abs(sides) > 0.3
    unlabelled = cloud_folder(tmp_path, label=None)
    assert (unlabelled.train.parts, unlabelled.part_names) == (None, ())
    assert unlabelled.fingerprint != data.fingerprint
    with pytest.raises(UserError, match=r"has no column 'part'. Its columns: kind\."):
        cloud_folder(tmp_path, label="part")
    with pytest.raises(UserError, match="label must be null with crop=surface"):
        cloud_folder(tmp_path, crop="surface", crops=1)
    write = Table(np.eye(3)[np.arange(60) % 3], {"kind": np.full(60, 0.5)})
    WRITERS[suffix](tmp_path / f"scan2{suffix}", write)
    with pytest.raises(UserError, match=r"'kind' must hold whole int64 numbers, got 0\.5\."):
        cloud_folder(tmp_path)
