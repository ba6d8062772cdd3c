"""``downsample(points, m, stratify=classes)``."""

from typing import NamedTuple

import numpy as np
import pytest
import torch

from mops_lightning import downsample
from mops_lightning.errors import UserError

CLOUD = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) * 7
CLASSES = torch.tensor([3, 7, -1]).repeat_interleave(torch.tensor([150, 47, 3]))
THREES = slice(0, 150)
SEVENS = slice(150, 197)


def kept_classes(rows, classes=CLASSES):
    """Return the number of kept points by class."""
    kept = torch.as_tensor(classes)[torch.as_tensor(rows)]
    names, counts = kept.unique(return_counts=True)
    return dict(zip(names.tolist(), counts.tolist(), strict=True))


@pytest.mark.parametrize("method", ["fps", "random", "voxel", "poisson", "serial"])
def test_stratify_keeps_shares(method):
    points, rows = downsample(CLOUD, 20, method, stratify=CLASSES)

    assert kept_classes(rows) == {3: 15, 7: 5}
    assert torch.equal(points, CLOUD[rows])
    assert rows.tolist() == sorted(set(rows.tolist()))


def test_stratify_min_keeps_rare_points():
    _, rows = downsample(CLOUD, 20, stratify=CLASSES, stratify_min=5)

    assert kept_classes(rows) == {-1: 3, 3: 12, 7: 5}


@pytest.mark.parametrize(
    ("sizes", "m", "least", "kept"),
    [
        # Shares of 2.5 each: the lower class has the odd point.
        ([100, 100], 5, None, {0: 3, 1: 2}),
        # Shares of 1.75, 1.75, 0.5: the largest remainders have the two points left.
        ([70, 70, 20], 4, None, {0: 2, 1: 2}),
        # Shares of 1.6, 1.6 and 0.8: rounded, they would be five points.
        ([40, 40, 20], 4, None, {0: 2, 1: 1, 2: 1}),
        # Beside the two rare classes, 12 points: four each, and 2.86 and 1.14 of the others.
        ([100, 60, 4, 4], 20, 4, {0: 7, 1: 5, 2: 4, 3: 4}),
        # One each, and of the other six 3.43, 1.71 and 0.85.
        ([50, 30, 20, 1], 10, 1, {0: 4, 1: 3, 2: 2, 3: 1}),
        # All points are those that every class keeps.
        ([30, 10], 4, 2, {0: 2, 1: 2}),
        # As many as the classes have.
        ([5, 3, 1], 9, 2, {0: 5, 1: 3, 2: 1}),
    ],
)
def test_stratify_shares_points_by_the_largest_remainder(sizes, m, least, kept):
    numbers = torch.tensor(sizes)
    classes = torch.arange(len(sizes)).repeat_interleave(numbers)
    cloud = torch.rand(sum(sizes), 3, generator=torch.Generator().manual_seed(1))

    _, rows = downsample(cloud, m, "random", stratify=classes, stratify_min=least)

    assert kept_classes(rows, classes) == kept


@pytest.mark.parametrize("least", [np.int64(5), torch.tensor(5)])
def test_stratify_min_takes_whole_numbers_of_numpy_and_torch(least):
    _, rows = downsample(CLOUD, 20, stratify=CLASSES, stratify_min=least)

    assert kept_classes(rows) == {-1: 3, 3: 12, 7: 5}


def test_stratify_samples_every_class_on_its_own():
    _, rows = downsample(CLOUD, 20, stratify=CLASSES)

    _, of_threes = downsample(CLOUD[THREES], 15)
    _, of_sevens = downsample(CLOUD[SEVENS], 5)
    expected = torch.cat([of_threes, 150 + of_sevens])
    assert rows.tolist() == sorted(expected.tolist())


@pytest.mark.parametrize("labels", [np.uint8, np.int64, ">i4"])
def test_stratify_takes_arrays_of_whole_numbers(labels):
    cloud = CLOUD.numpy()
    classes = CLASSES.abs().numpy()
    given = classes.astype(labels)

    points, rows = downsample(cloud, 0.1, stratify=given, stratify_min=5)

    assert isinstance(points, np.ndarray)
    assert kept_classes(rows, classes) == {1: 3, 3: 12, 7: 5}


def test_stratify_with_weights_keeps_heavy_points_of_each_class():
    weight = torch.ones(200)
    weight[[0, 160]] = 1000.0

    _, rows = downsample(CLOUD, 20, "random", weight=weight, stratify=CLASSES)

    assert {0, 160} <= set(rows.tolist())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"stratify": CLASSES[1:]}, "stratify must hold the class of every point"),
        ({"stratify": CLASSES.float()}, "stratify must hold whole numbers, got torch.float32"),
        ({"stratify": [CLASSES]}, "stratify must be whole numbers"),
        ({"stratify": CLASSES, "stratify_min": 0}, "stratify_min must be a whole number"),
        ({"stratify": CLASSES, "stratify_min": True}, "stratify_min must be a whole number"),
        ({"stratify": CLASSES, "stratify_min": 9}, "9 points of each of the 3 classes are 21"),
        ({"stratify_min": 9}, "stratify_min needs stratify"),
        ({"stratify": CLASSES, "m": None, "voxel": 1.0}, "no spacing or voxel"),
        ({"stratify": CLASSES, "m": 201}, "m must be at most the number of points N=200"),
        ({"stratify": CLASSES, "start": 3}, "no start row"),
        ({"stratify": CLASSES, "readout": "matched"}, "no readout 'matched'"),
    ],
)
def test_stratify_refuses(arguments, words):
    with pytest.raises(UserError, match=words):
        downsample(CLOUD, **{"m": 20, **arguments})


class TwoClouds(NamedTuple):
    """Two clouds, their classes, and the rows that each alone would keep."""

    clouds: torch.Tensor
    classes: torch.Tensor
    rows: list[list[int]]


@pytest.fixture
def two_clouds():
    clouds = torch.stack([CLOUD, CLOUD.flip(0)])
    classes = torch.stack([CLASSES, CLASSES.flip(0)])
    rows = []
    for cloud, of_cloud in zip(clouds, classes, strict=True):
        _, kept = downsample(cloud, 20, stratify=of_cloud, stratify_min=5)
        rows.append(kept.tolist())
    return TwoClouds(clouds, classes, rows)


def test_stratify_of_a_batch(two_clouds):
    _, rows = downsample(two_clouds.clouds, 20, stratify=two_clouds.classes, stratify_min=5)

    assert rows.tolist() == two_clouds.rows


def test_stratify_of_a_list(two_clouds):
    clouds = list(two_clouds.clouds)
    classes = list(two_clouds.classes)

    _, rows = downsample(clouds, 20, stratify=classes, stratify_min=5)

    first, second = rows
    assert [first.tolist(), second.tolist()] == two_clouds.rows


def test_stratify_of_a_flat_batch(two_clouds):
    clouds = two_clouds.clouds.flatten(0, 1)
    classes = two_clouds.classes.flatten()
    batch = torch.arange(2).repeat_interleave(200)

    _, rows = downsample(clouds, 20, batch=batch, stratify=classes, stratify_min=5)

    first, second = two_clouds.rows
    second_in_batch = [200 + row for row in second]
    assert rows.tolist() == [*first, *second_in_batch]
