"""``downsample(points, m, stratify=classes)``."""

import numpy as np
import pytest
import torch

from mops_lightning import downsample
from mops_lightning.errors import UserError

CLOUD = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) * 7
CLASSES = torch.tensor([3] * 150 + [7] * 47 + [-1] * 3)


def kept_classes(rows, classes=CLASSES):
    names, counts = torch.as_tensor(classes)[torch.as_tensor(rows)].unique(return_counts=True)
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


@pytest.mark.parametrize("least", [np.int64(5), torch.tensor(5)])
def test_stratify_min_takes_whole_numbers_of_numpy_and_torch(least):
    _, rows = downsample(CLOUD, 20, stratify=CLASSES, stratify_min=least)

    assert kept_classes(rows) == {-1: 3, 3: 12, 7: 5}


def test_stratify_samples_every_class_on_its_own():
    _, rows = downsample(CLOUD, 20, stratify=CLASSES)

    _, of_three = downsample(CLOUD[:150], 15)
    _, of_seven = downsample(CLOUD[150:197], 5)
    assert rows.tolist() == sorted([*of_three.tolist(), *(150 + of_seven).tolist()])


@pytest.mark.parametrize("labels", [np.uint8, np.int64, ">i4"])
def test_stratify_takes_arrays_of_whole_numbers(labels):
    classes = np.abs(CLASSES.numpy()).astype(labels)

    points, rows = downsample(CLOUD.numpy(), 0.1, stratify=classes, stratify_min=5)

    assert isinstance(points, np.ndarray)
    assert kept_classes(rows, classes.astype(int)) == {1: 3, 3: 12, 7: 5}


def test_stratify_of_a_batch_a_list_and_a_flat_batch():
    flipped = CLASSES.flip(0)
    both = torch.stack([CLOUD, CLOUD.flip(0)])
    batch = torch.arange(2).repeat_interleave(200)
    one = downsample(CLOUD, 20, stratify=CLASSES, stratify_min=5)[1]
    other = downsample(CLOUD.flip(0), 20, stratify=flipped, stratify_min=5)[1]

    _, stacked = downsample(both, 20, stratify=torch.stack([CLASSES, flipped]), stratify_min=5)
    _, listed = downsample(list(both), 20, stratify=[CLASSES, flipped], stratify_min=5)
    joined = torch.cat([CLASSES, flipped])
    _, flat = downsample(both.flatten(0, 1), 20, batch=batch, stratify=joined, stratify_min=5)

    assert stacked.tolist() == [one.tolist(), other.tolist()]
    assert [rows.tolist() for rows in listed] == [one.tolist(), other.tolist()]
    assert flat.tolist() == [*one.tolist(), *(200 + other).tolist()]


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
