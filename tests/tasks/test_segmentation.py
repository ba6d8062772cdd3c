"""Segmentation: parts of all points from the sampled ones; see test_contract for all tasks."""

import math
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional as F
from torch.testing import assert_close

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


def small_net(parts):
    points = (20, 8)
    channels = (8, 16, 16)
    return HierarchicalSegmentation(parts, FPSSampler, points, channels, k=4)


def plainly_interpolated(values, points, query):
    """Return the mean of the values at the 3 nearest points, weighted by inverse squares."""
    squared = (points - query).square().sum(1)
    near = squared.argsort()[:3]
    weights = 1 / squared[near]
    weighted = values[near] * weights[:, None]
    return weighted.sum(0) / weights.sum()


def test_interpolation_equals_plain_loops(rand):
    values = rand(2, 6, 4)
    points = rand(2, 6, 3)
    queries = rand(2, 9, 3)

    found = interpolate(values, points, queries)

    for cloud in range(2):
        for query, row in zip(queries[cloud], found[cloud], strict=True):
            expected = plainly_interpolated(values[cloud], points[cloud], query)
            assert_close(row, expected, rtol=1e-4, atol=1e-5)


def test_interpolation_at_the_points_returns_their_values(rand):
    values = rand(2, 6, 4)
    points = rand(2, 6, 3)

    found = interpolate(values, points, points)

    assert_close(found, values, rtol=1e-4, atol=1e-4)


def test_interpolation_from_a_single_point_keeps_its_shape(rand):
    values = rand(2, 1, 4)
    points = rand(2, 1, 3)
    queries = rand(2, 9, 3)

    assert interpolate(values, points, queries).shape == (2, 9, 4)


def test_interpolation_gradients_equal_differences(rand):
    values = rand(1, 6, 4, dtype=torch.float64, requires_grad=True)
    points = rand(1, 6, 3, dtype=torch.float64, requires_grad=True)
    queries = rand(1, 9, 3, dtype=torch.float64, requires_grad=True)

    assert torch.autograd.gradcheck(interpolate, (values, points, queries))


def iou(predictions, parts, part):
    """Return the intersection over union of one part."""
    predicted = predictions == part
    labelled = parts == part
    both = (predicted & labelled).sum()
    either = (predicted | labelled).sum()
    return (both / either).item()


@pytest.fixture
def halves(randn):
    """Clouds with two halves, x above 0 and below."""
    points = randn(3, 200, 3)
    parts = (points[..., 0] > 0).long()
    labels = torch.zeros(3, dtype=torch.int64)
    return Batch(points, labels, parts=parts)


def test_all_points_are_scored_from_few(halves):
    task = Segmentation(Halves(), 2)

    few = task.step(halves, halves.points[:, :25])

    assert few.predictions.shape == (3, 200)
    assert few.targets.shape == (3, 200)
    right = few.predictions.eq(halves.parts).float().mean()
    assert 0.7 < right < 1
    metrics = task.metrics()
    metrics.update(few.predictions, few.targets)
    values = metrics.compute()
    assert values["point_accuracy"] == pytest.approx(right.item())
    left_iou = iou(few.predictions, halves.parts, 0)
    right_iou = iou(few.predictions, halves.parts, 1)
    mean_iou = (left_iou + right_iou) / 2
    assert values["mean_iou"] == pytest.approx(mean_iou, abs=1e-6)


def test_loss_of_all_points_is_below_that_of_few(halves):
    task = Segmentation(Halves(), 2)

    few = task.step(halves, halves.points[:, :25])
    every = task.step(halves, halves.points)

    assert every.losses["cross_entropy"] < few.losses["cross_entropy"]


def test_prediction_of_a_copy_of_the_points_is_the_same(halves):
    task = Segmentation(Halves(), 2)

    same = task.predict(halves, halves.points)
    copy = task.predict(halves, halves.points.clone())

    assert_close(same, copy, atol=1e-2, rtol=1e-4)


def test_segmentation_without_parts_is_refused(halves):
    task = Segmentation(Halves(), 2)
    without_parts = halves._replace(parts=None)

    with pytest.raises(UserError, match="needs clouds whose points have parts"):
        task.step(without_parts, halves.points)


def test_segmentation_into_one_part_is_refused():
    with pytest.raises(UserError, match=r"num_parts must be at least 2, got 1\."):
        Segmentation(Halves(), 1)


def test_points_of_unknown_part_are_neither_learned_nor_scored(randn, rand):
    points = randn(2, 99, 3)
    known = rand(2, 99) > 0.3
    parts = (points[..., 1] > 0).long()
    labels = torch.zeros(2).long()
    some_known = Batch(points, labels, parts=parts.where(known, UNKNOWN))
    none_known = Batch(points, labels, parts=torch.full_like(parts, UNKNOWN))
    task = Segmentation(Halves(), 2)

    found = task.step(some_known, points)
    nothing = task.step(none_known, points)

    logits = task.predict(some_known, points)
    loss = F.cross_entropy(logits[known], parts[known])
    assert_close(found.losses["cross_entropy"], loss)
    scores = task.metrics()(found.predictions, found.targets)
    scores_of_known = task.metrics()(found.predictions[known], parts[known])
    assert scores == scores_of_known
    assert nothing.losses["cross_entropy"] == 0


def test_loss_of_a_single_known_point_is_its_own(randn):
    points = randn(2, 30, 3)
    parts = torch.full((2, 30), UNKNOWN)
    parts[1, 7] = 1
    batch = Batch(points, torch.zeros(2).long(), parts=parts)
    task = Segmentation(small_net(2), 2).eval()

    result = task.step(batch, points)

    (logits,) = task.predict(batch, points)[1:, 7]
    expected = F.cross_entropy(logits, torch.tensor(1))
    assert_close(result.losses["cross_entropy"], expected)


def test_step_passes_on_the_logits_of_all_points(halves):
    task = Segmentation(Halves(), 2)
    sample = halves.points[:, :25]

    result = task.step(halves, sample)

    assert_close(result.output, task.predict(halves, sample))


def test_disagreement_is_the_mean_divergence_of_the_points_of_a_cloud():
    task = Segmentation(Halves(), 2)
    even = torch.tensor([0.5, 0.5]).log()
    uneven = torch.tensor([0.9, 0.1]).log()
    found = torch.stack([uneven, even, even])
    reference = torch.stack([uneven, uneven, even])

    apart = task.disagreement(found[None], reference[None])

    of_second_point = 0.9 * math.log(0.9 / 0.5) + 0.1 * math.log(0.1 / 0.5)
    assert apart.tolist() == pytest.approx([of_second_point / 3])


@pytest.mark.parametrize("k", [0, -1])
def test_interpolation_from_no_point_is_refused(k):
    with pytest.raises(UserError, match=rf"k must be at least 1, got {k}\."):
        Segmentation(Halves(), 2, k)


def test_net_follows_order_of_points(rng, randn):
    net = small_net(5).eval()
    points = randn(2, 40, 3)
    order = torch.randperm(40, generator=rng)

    logits = net(points)
    logits_in_order = net(points[:, order])

    assert logits.shape == (2, 40, 5)
    assert_close(logits_in_order, logits[:, order], atol=1e-4, rtol=1e-4)


def test_net_takes_fewer_points_than_its_stages_sample(randn):
    net = small_net(5).eval()
    points = randn(2, 3, 3)

    logits = net(points)

    assert logits.shape == (2, 3, 5)


def test_net_trains_every_weight(randn):
    net = small_net(5).train()
    points = randn(2, 40, 3)

    loss = net(points).square().sum()
    loss.backward()

    for name, weights in net.named_parameters():
        assert weights.grad is not None, name


def test_shapes_know_their_parts(tmp_path):
    make = partial(shapes, n_points=256, train_per_class=12, test_per_class=2, cache=tmp_path)

    data = make(classes="parts")
    from_cache = make(classes="parts")
    alone = make(classes=["chair"])
    without_parts = make(classes=["chair", "sofa"])

    train: Any = data.train
    for label, name in enumerate(data.class_names):
        is_of_class = train.labels == label
        parts_of_class = train.parts[is_of_class].unique()
        names = {data.part_names[part] for part in parts_of_class}
        assert names <= set(PARTS[name])
    seat = data.part_names.index("seat")
    leg = data.part_names.index("leg")
    for cloud, parts in zip(train.points, train.parts, strict=True):
        is_seat = parts == seat
        is_leg = parts == leg
        if is_seat.any():
            height = cloud[:, 1]
            assert height[is_leg].mean() < height[is_seat].mean()
    cached: Any = from_cache.train
    assert torch.equal(cached.parts, train.parts)
    is_chair = train.labels == data.class_names.index("chair")
    assert alone.part_names == PARTS["chair"]
    assert torch.equal(alone.train.points, train.points[is_chair])
    assert train.take(is_chair).parts.shape == (12, 256)
    assert without_parts.part_names == ()


@pytest.fixture(params=[".ply", ".npz"])
def scans(request, tmp_path, rand):
    """A folder of two scans, whose columns ``kind`` hold other numbers left and right."""
    suffix = request.param
    for number, kinds in enumerate(([7, 2], [2, 40])):
        points = rand(60, 3).double().numpy()
        kind = np.where(points[:, 0] > 0.5, *kinds).astype(np.int16)
        kind[::4] = -1 - number
        WRITERS[suffix](tmp_path / f"scan{number}{suffix}", Table(points, {"kind": kind}))
    return tmp_path


def test_scans_have_parts_of_their_own(scans):
    data = cloud_folder(scans)

    assert data.part_names == ("2", "7", "40")
    splits: list[Any] = [data.train, data.test]
    for clouds in splits:
        for cloud, parts in zip(clouds.points, clouds.parts, strict=True):
            unknown, low, high = parts.unique().tolist()
            assert unknown == UNKNOWN
            x = cloud[:, 0]
            between = x[parts == high].mean() - x[parts == low].mean()
            assert abs(between) > 0.3


def test_scans_without_label_have_no_parts(scans):
    labelled = cloud_folder(scans)

    unlabelled = cloud_folder(scans, label=None)

    assert unlabelled.train.parts is None
    assert unlabelled.part_names == ()
    assert unlabelled.fingerprint != labelled.fingerprint


def test_scans_with_an_unsuitable_label_are_refused(scans):
    with pytest.raises(UserError, match=r"has no column 'part'. Its columns: kind\."):
        cloud_folder(scans, label="part")
    with pytest.raises(UserError, match="label must be null with crop=surface"):
        cloud_folder(scans, crop="surface", crops=1)


def test_scans_with_broken_numbers_as_labels_are_refused(scans):
    (first,) = scans.glob("scan0.*")
    suffix = first.suffix
    points = np.tile(np.eye(3), (20, 1))
    kind = np.full(60, 0.5)
    WRITERS[suffix](scans / f"scan2{suffix}", Table(points, {"kind": kind}))

    with pytest.raises(UserError, match=r"'kind' must hold whole int64 numbers, got 0\.5\."):
        cloud_folder(scans)
