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
from mops_lightning.tasks.base import figures_of
from mops_lightning.tasks.segmentation import Segmentation
from mops_lightning.types import UNKNOWN, Batch

cloud_folder = partial(
    folder.cloud_folder,
    test_frames=None,
    crop="whole",
    crops=2,
    n_points=20,
    label="kind",
)


class Halves(nn.Module):
    """Knows the sign of x."""

    def forward(self, points):
        right = 50 * points[..., 0]
        left = -right
        return torch.stack([left, right], 2)


def small_net(parts):
    points = (20, 8)
    channels = (8, 16, 16)
    return HierarchicalSegmentation(parts, FPSSampler, points, channels, k=4)


def plainly_interpolated(values, points, query):
    """Return the mean of the values at the 3 nearest points, weighted by inverse squares."""
    offsets = points - query
    squared = offsets.square().sum(1)
    in_order = squared.argsort()
    nearest = in_order[:3]
    weights = 1 / squared[nearest]
    weighted = values[nearest] * weights[:, None]
    total = weighted.sum(0)
    return total / weights.sum()


def test_interpolation_equals_plain_loops(rand):
    values = rand(2, 6, 4)
    points = rand(2, 6, 3)
    queries = rand(2, 9, 3)

    found = interpolate(values, points, queries)

    assert found.shape == (2, 9, 4)
    for cloud in range(2):
        of_cloud = values[cloud]
        points_of_cloud = points[cloud]
        for number in range(9):
            query = queries[cloud, number]
            expected = plainly_interpolated(of_cloud, points_of_cloud, query)
            assert_close(found[cloud, number], expected, rtol=1e-4, atol=1e-5)


def test_interpolation_at_the_points_returns_their_values(rand):
    values = rand(2, 6, 4)
    points = rand(2, 6, 3)

    found = interpolate(values, points, points)

    assert_close(found, values, rtol=1e-4, atol=1e-4)


def test_interpolation_from_a_single_point_keeps_its_shape(rand):
    values = rand(2, 1, 4)
    points = rand(2, 1, 3)
    queries = rand(2, 9, 3)

    found = interpolate(values, points, queries)

    assert found.shape == (2, 9, 4)


def test_interpolation_gradients_equal_differences(rand):
    differentiable = partial(rand, dtype=torch.float64, requires_grad=True)
    values = differentiable(1, 6, 4)
    points = differentiable(1, 6, 3)
    queries = differentiable(1, 9, 3)

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
    is_right = points[..., 0] > 0
    labels = torch.zeros(3, dtype=torch.int64)
    return Batch(points, labels, parts=is_right.long())


def test_all_points_are_scored_from_few(halves):
    task = Segmentation(Halves(), 2)
    sample = halves.points[:, :25]

    result = task.step(halves, sample)

    predictions = result.predictions
    assert predictions.shape == (3, 200)
    assert result.targets.shape == (3, 200)
    is_right = predictions == halves.parts
    accuracy = is_right.float().mean()
    assert 0.7 < accuracy < 1
    iou_of_left = iou(predictions, halves.parts, 0)
    iou_of_right = iou(predictions, halves.parts, 1)
    mean_iou = (iou_of_left + iou_of_right) / 2
    metrics = task.metrics()
    metrics.update(predictions, result.targets)
    values = metrics.compute()
    assert values["point_accuracy"] == pytest.approx(accuracy.item())
    assert values["mean_iou"] == pytest.approx(mean_iou, abs=1e-6)


def test_loss_of_all_points_is_below_that_of_few(halves):
    task = Segmentation(Halves(), 2)

    few = task.step(halves, halves.points[:, :25])
    every = task.step(halves, halves.points)

    loss_of_few = few.losses["cross_entropy"]
    loss_of_all = every.losses["cross_entropy"]
    assert loss_of_all < loss_of_few


def test_prediction_of_a_copy_of_the_points_is_the_same(halves):
    task = Segmentation(Halves(), 2)

    copy = halves.points.clone()

    of_points = task.predict(halves, halves.points)
    of_copy = task.predict(halves, copy)

    assert_close(of_points, of_copy, atol=1e-2, rtol=1e-4)


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
    is_known = rand(2, 99) > 0.3
    is_above = points[..., 1] > 0
    all_parts = is_above.long()
    some_parts = all_parts.where(is_known, UNKNOWN)
    no_parts = torch.full_like(all_parts, UNKNOWN)
    labels = torch.zeros(2).long()
    some_known = Batch(points, labels, parts=some_parts)
    none_known = Batch(points, labels, parts=no_parts)
    task = Segmentation(Halves(), 2)

    of_some = task.step(some_known, points)
    of_none = task.step(none_known, points)

    known_parts = all_parts[is_known]
    logits = task.predict(some_known, points)
    expected_loss = F.cross_entropy(logits[is_known], known_parts)
    assert_close(of_some.losses["cross_entropy"], expected_loss)
    metrics = task.metrics()
    metrics_of_known = task.metrics()
    scores = metrics(of_some.predictions, of_some.targets)
    expected_scores = metrics_of_known(of_some.predictions[is_known], known_parts)
    assert scores == expected_scores
    assert of_none.losses["cross_entropy"] == 0


def test_loss_of_a_single_known_point_is_its_own(randn):
    points = randn(2, 30, 3)
    labels = torch.zeros(2).long()
    part = torch.tensor(1)
    parts = torch.full((2, 30), UNKNOWN)
    parts[1, 7] = part
    batch = Batch(points, labels, parts=parts)
    task = Segmentation(small_net(2), 2)
    task.eval()

    result = task.step(batch, points)

    logits = task.predict(batch, points)
    expected = F.cross_entropy(logits[1, 7], part)
    assert_close(result.losses["cross_entropy"], expected)


def test_step_passes_on_the_logits_of_all_points(halves):
    task = Segmentation(Halves(), 2)
    sample = halves.points[:, :25]

    result = task.step(halves, sample)

    assert_close(result.output, task.predict(halves, sample))


def test_disagreement_is_the_mean_divergence_of_the_points_of_a_cloud():
    task = Segmentation(Halves(), 2)
    even = [0.5, 0.5]
    uneven = [0.9, 0.1]
    found = torch.tensor([[uneven, even, even]])
    reference = torch.tensor([[uneven, uneven, even]])

    apart = task.disagreement(found.log(), reference.log())

    of_first_part = 0.9 * math.log(0.9 / 0.5)
    of_second_part = 0.1 * math.log(0.1 / 0.5)
    of_second_point = of_first_part + of_second_part
    mean_of_points = of_second_point / 3
    assert apart.tolist() == pytest.approx([mean_of_points])


@pytest.mark.parametrize("k", [0, -1])
def test_interpolation_from_no_point_is_refused(k):
    net = Halves()

    with pytest.raises(UserError, match=rf"k must be at least 1, got {k}\."):
        Segmentation(net, 2, k)


def test_net_follows_order_of_points(rng, randn):
    net = small_net(5).eval()
    points = randn(2, 40, 3)
    order = torch.randperm(40, generator=rng)
    reordered = points[:, order]

    logits = net(points)
    logits_of_reordered = net(reordered)

    assert logits.shape == (2, 40, 5)
    expected = logits[:, order]
    assert_close(logits_of_reordered, expected, atol=1e-4, rtol=1e-4)


def test_net_takes_fewer_points_than_its_stages_sample(randn):
    net = small_net(5).eval()
    points = randn(2, 3, 3)

    logits = net(points)

    assert logits.shape == (2, 3, 5)


def test_net_trains_every_weight(randn):
    net = small_net(5).train()
    points = randn(2, 40, 3)

    logits = net(points)
    loss = logits.square().sum()
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
        parts_of_class = train.parts[is_of_class]
        names = {data.part_names[part] for part in parts_of_class.unique()}
        assert names <= set(PARTS[name])
    seat = data.part_names.index("seat")
    leg = data.part_names.index("leg")
    for cloud, parts in zip(train.points, train.parts, strict=True):
        is_seat = parts == seat
        is_leg = parts == leg
        if is_seat.any():
            height = cloud[:, 1]
            height_of_legs = height[is_leg].mean()
            height_of_seat = height[is_seat].mean()
            assert height_of_legs < height_of_seat
    cached: Any = from_cache.train
    assert torch.equal(cached.parts, train.parts)
    chair = data.class_names.index("chair")
    is_chair = train.labels == chair
    chairs = train.take(is_chair)
    assert alone.part_names == PARTS["chair"]
    assert torch.equal(alone.train.points, train.points[is_chair])
    assert chairs.parts.shape == (12, 256)
    assert without_parts.part_names == ()


KINDS_OF_SCANS = [
    ("scan0", 7, 2, -1),
    ("scan1", 2, 40, -2),
]
"""Each scan's name, its kinds on the right and on the left, and its value for unknown."""


@pytest.fixture(params=[".ply", ".npz"])
def scans(request, tmp_path, rand):
    """A folder of two scans, whose columns ``kind`` hold other numbers left and right."""
    suffix = request.param
    write = WRITERS[suffix]
    for name, kind_of_right, kind_of_left, unknown in KINDS_OF_SCANS:
        points = rand(60, 3).double().numpy()
        is_right = points[:, 0] > 0.5
        kind = np.where(is_right, kind_of_right, kind_of_left)
        kind[::4] = unknown
        columns = {"kind": kind.astype(np.int16)}
        path = tmp_path / f"{name}{suffix}"
        write(path, Table(points, columns))
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
            x_of_high = x[parts == high].mean()
            x_of_low = x[parts == low].mean()
            assert abs(x_of_high - x_of_low) > 0.3


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
    table = Table(points, {"kind": kind})
    path = scans / f"scan2{suffix}"
    write = WRITERS[suffix]
    write(path, table)

    with pytest.raises(UserError, match=r"'kind' must hold whole int64 numbers, got 0\.5\."):
        cloud_folder(scans)


def test_figure_shows_true_parts_and_those_predicted_from_every_readout(halves):
    task = Segmentation(Halves(), 2)
    sample = halves.points[:, :3]

    figures = figures_of(task, halves, {"fps": sample}, ["a", "b", "c"])

    true, predicted = figures["parts"].axes[2:4]  # of the second cloud
    (drawn_true,) = true.collections
    (drawn_predicted,) = predicted.collections
    result = task.step(halves, sample)
    titles = [axes.get_title() for axes in figures["parts"].axes[:2]]
    assert titles == ["true parts", "fps"]
    assert np.asarray(drawn_true.get_array()).tolist() == halves.parts[1].tolist()
    assert np.asarray(drawn_predicted.get_array()).tolist() == result.predictions[1].tolist()
    assert not torch.equal(result.predictions[1], halves.parts[1])
