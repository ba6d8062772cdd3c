"""Clouds of different sizes: from a folder to batches, and scores as of each cloud alone."""

from typing import Any

import numpy as np
import pytest
import torch

from mops_lightning.data.cloud_folder import cloud_folder
from mops_lightning.data.clouds import Clouds
from mops_lightning.data.corruptions import corrupt
from mops_lightning.data.formats.registry import read
from mops_lightning.data.loader import CloudLoader
from mops_lightning.errors import UserError
from mops_lightning.ops.points import UnitSphere
from mops_lightning.records.run_record import read as read_record
from mops_lightning.seeding import generator
from tests.support.command_line import call, done, refused, runs

SIZES = (40, 90, 60, 120, 75, 50, 44, 99)
"""The first half is for training."""


def write_clouds(folder, sizes=SIZES):
    """Write boxes and balls, with the part of every point."""
    for number, size in enumerate(sizes):
        random = np.random.default_rng(number)
        points = random.uniform(-1, 1, (size, 3))
        kind = "box"
        if number % 2:
            kind = "ball"
            points /= np.linalg.norm(points, axis=1, keepdims=True)
        split = "test"
        if number < len(sizes) // 2:
            split = "train"
        path = folder / kind / split / f"{number}.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        part = (points[:, 2] > 0).astype("int64")
        np.savez(path, xyz=points + 50, half=part)


@pytest.fixture
def folder(tmp_path):
    write_clouds(tmp_path / "clouds")
    return tmp_path / "clouds"


def dataset_of(folder, **arguments):
    settings: dict[str, Any] = {
        "test_frames": None,
        "crop": "whole",
        "crops": None,
        "label": "half",
    }
    return cloud_folder(folder, None, **settings, **arguments)


def in_order(points):
    """Return points as sorted tuples of four digits."""
    return sorted(tuple(row) for row in points.round(decimals=4).tolist())


def test_clouds_of_a_folder_keep_all_their_points(folder):
    data = dataset_of(folder)

    train = data.train
    assert train.sizes is not None
    assert sorted(train.sizes.tolist()) == [40, 60, 90, 120]
    first_box, *_ = sorted((folder / "box" / "train").iterdir())
    points = read(first_box, 0, 0).points
    expected = UnitSphere.around(points).normalise(points)
    is_box = train.labels == 1
    size = int(train.sizes[is_box][0])
    found = train.points[is_box][0, :size]
    assert len(points) == size
    assert in_order(found) == in_order(expected)


def test_clouds_of_a_folder_are_repeated_up_to_the_largest_with_their_parts(folder):
    data = dataset_of(folder)

    train = data.train
    assert train.sizes is not None
    assert train.parts is not None
    assert train.points.shape == (4, 120, 3)
    for points, parts, size in zip(train.points, train.parts, train.sizes, strict=True):
        number = min(int(size), 120 - int(size))
        repeated = slice(int(size), int(size) + number)
        assert torch.equal(points[repeated], points[:number])
        assert torch.equal(parts[repeated], parts[:number])


def test_clouds_of_one_size_have_no_sizes(tmp_path):
    write_clouds(tmp_path / "clouds", (50, 50, 50, 50))

    data = dataset_of(tmp_path / "clouds")

    assert data.train.sizes is None
    assert data.train.points.shape == (2, 50, 3)


def test_clouds_of_which_the_first_is_the_largest_have_sizes(tmp_path):
    write_clouds(tmp_path / "clouds", (50, 90, 50, 50))

    data = dataset_of(tmp_path / "clouds")

    assert data.train.sizes is not None
    assert sorted(data.train.sizes.tolist()) == [50, 90]


def test_loader_without_shuffle_gives_each_cloud_with_all_its_points(folder):
    clouds = dataset_of(folder).test
    assert clouds.sizes is not None
    assert clouds.parts is not None

    batches = list(CloudLoader(clouds, 4))

    assert [batch.points.shape[1] for batch in batches] == clouds.sizes.tolist()
    for row, batch in enumerate(batches):
        size = int(clouds.sizes[row])
        assert torch.equal(batch.points[0], clouds.points[row, :size])
        assert torch.equal(batch.parts[0], clouds.parts[row, :size])


def test_loader_with_shuffle_gives_different_points_of_every_cloud_once(folder):
    clouds = dataset_of(folder).train
    assert clouds.sizes is not None
    assert clouds.parts is not None
    seen = []

    for batch in CloudLoader(clouds, 3, shuffle=True):
        sizes = clouds.sizes[batch.rows]
        assert batch.points.shape[1] == sizes.min()
        for points, parts, row in zip(batch.points, batch.parts, batch.rows, strict=True):
            cloud = clouds.points[row, : clouds.sizes[row]]
            is_same = (points[:, None] == cloud).all(2)
            assert is_same.sum(1).tolist() == [1] * len(points)
            assert is_same.sum(0).max() == 1
            places = is_same.int().argmax(1)
            assert torch.equal(parts, clouds.parts[row][places])
        seen.extend(batch.rows.tolist())

    assert sorted(seen) == [0, 1, 2, 3]


def test_loader_with_shuffle_puts_clouds_of_similar_sizes_together():
    sizes = torch.arange(20, 60)
    points = torch.rand(40, 59, 3)
    clouds = Clouds(points, torch.zeros(40, dtype=torch.long), sizes=sizes)

    batches = list(CloudLoader(clouds, 5, shuffle=True))

    assert len(batches) == 8
    for batch in batches:
        of_batch = sizes[batch.rows]
        assert of_batch.max() - of_batch.min() == 4


def test_loader_sorts_the_clouds_of_eight_batches_by_size():
    sizes = torch.randperm(80, generator=generator(1)) + 10
    clouds = Clouds(torch.rand(80, 89, 3), torch.zeros(80, dtype=torch.long), sizes=sizes)

    batches = list(CloudLoader(clouds, 5, shuffle=True, seed=3))

    drawn = torch.randperm(80, generator=generator(3, 0))
    first = torch.cat([batch.rows for batch in batches[:8]])
    second = torch.cat([batch.rows for batch in batches[8:]])
    assert first.tolist() == sorted(drawn[:40].tolist(), key=lambda row: sizes[row])
    assert second.tolist() == sorted(drawn[40:].tolist(), key=lambda row: sizes[row])


def test_loader_batch_of_chosen_clouds_has_points_of_each_with_their_parts():
    points = torch.rand(3, 60, 3)
    parts = torch.arange(180).view(3, 60)
    sizes = torch.tensor([60, 40, 55])
    clouds = Clouds(points, torch.tensor([4, 5, 6]), parts=parts, sizes=sizes)
    rows = torch.tensor([2, 1])

    batch = CloudLoader(clouds, 4, seed=5).batch_of(rows)

    drawn = torch.rand(2, 60, generator=generator(14, 5))
    for number, row in enumerate(rows.tolist()):
        kept = drawn[number, : sizes[row]].argsort()[:40].sort().values
        assert torch.equal(batch.points[number], points[row][kept])
        assert torch.equal(batch.parts[number], parts[row][kept])
    assert batch.labels.tolist() == [6, 5]
    assert torch.equal(batch.rows, rows)


def test_loader_points_depend_on_epoch_and_continue_after_a_stop(folder):
    clouds = dataset_of(folder).train
    loader = CloudLoader(clouds, 2, shuffle=True)
    first = [batch.points for batch in loader]
    second = [batch.points for batch in loader]
    resumed = CloudLoader(clouds, 2, shuffle=True)
    resumed.load_state_dict({"epoch": 1, "position": 1})

    rest = [batch.points for batch in resumed]

    assert torch.equal(rest[0], second[1])
    assert not all(map(torch.equal, first, second))


def test_loader_draws_other_points_in_every_epoch_batch_and_with_every_seed():
    """One cloud of 90 points is always in a batch with one of 40 or 41."""
    points = torch.rand(4, 90, 3)
    sizes = torch.tensor([90, 40, 90, 40])
    clouds = Clouds(points, torch.zeros(4, dtype=torch.long), sizes=sizes)

    def chosen(seed=0):
        """Return the rows that were kept of each cloud, epoch by epoch."""
        loader = CloudLoader(clouds, 4, shuffle=True, seed=seed)
        kept = []
        for _ in range(2):
            for batch in loader:
                for row, cloud in zip(batch.rows, batch.points, strict=True):
                    is_same = (cloud[:, None] == points[row]).all(2)
                    kept.append((int(row), is_same.int().argmax(1).tolist()))
        return kept

    rows_of_large = [rows for cloud, rows in chosen() if cloud in (0, 2)]
    rows_of_other_seed = [rows for cloud, rows in chosen(seed=1) if cloud in (0, 2)]

    for rows in [*rows_of_large, *rows_of_other_seed]:
        assert rows == sorted(rows)
        assert len(rows) == 40
    different = {tuple(rows) for rows in [*rows_of_large, *rows_of_other_seed]}
    assert len(different) == 8


def test_loader_draws_the_points_of_every_batch_from_a_stream_of_its_own():
    """The published draw: of random numbers in (0, 1), those of the smallest ones, in order."""
    points = torch.rand(6, 60, 3)
    sizes = torch.tensor([60, 40, 55, 45, 50, 42])
    clouds = Clouds(points, torch.zeros(6, dtype=torch.long), sizes=sizes)

    batches = list(CloudLoader(clouds, 2, shuffle=True, seed=5))

    for number, batch in enumerate(batches):
        drawn = torch.rand(2, 60, generator=generator(14, 5, 0, number))
        fewest = int(sizes[batch.rows].min())
        for row, numbers, cloud in zip(batch.rows, drawn, batch.points, strict=True):
            of_cloud = numbers[: sizes[row]]
            kept = of_cloud.argsort()[:fewest].sort().values
            assert torch.equal(cloud, points[row][kept])
    assert len(batches) == 3


RUN = [
    "task=classification",
    "dataset=clouds",
    "dataset.root=clouds",
    "dataset.crop=whole",
    "dataset.n_points=null",
    "trainer=cpu",
    "batch_size=3",
    "m=8",
    "val_fraction=0",
    "weights=null",
    "logger=none",
    "trainer.max_epochs=1",
]


@pytest.mark.parametrize(
    "chosen",
    [
        ["sampler=mops", "pictures=2"],
        ["sampler=fps", "task=segmentation", "dataset.label=half", "learn=joint", "pictures=0"],
        ["sampler=fps", "pictures=0", "task=registration", "task.net.feature_channels=[16,32]"],
    ],
    ids=["classification", "segmentation", "registration"],
)
def test_run_on_clouds_of_different_sizes_trains_and_scores_all(chosen, folder, tmp_path):
    done([*RUN, *chosen], tmp_path)

    (run,) = runs(tmp_path)
    record = read_record(run)
    assert record.test_clouds == 4
    assert record.score is not None
    assert np.isfinite(record.score)


def test_run_scores_clouds_of_different_sizes_as_each_alone(folder, tmp_path):
    """The twin: test every cloud in a run of its own data set."""
    done([*RUN, "sampler=mops", "pictures=0"], tmp_path)
    (run,) = runs(tmp_path)
    together = read_record(run).metrics
    alone = []
    clouds = sorted(folder.glob("*/test/*.npz"))

    for number, path in enumerate(clouds):
        single = tmp_path / f"single{number}"
        kind = path.parent.parent.name
        for name in ("ball", "box"):
            (single / name / "train").mkdir(parents=True)
            (single / name / "train" / "0.npz").write_bytes(path.read_bytes())
        (single / kind / "test").mkdir()
        (single / kind / "test" / path.name).write_bytes(path.read_bytes())
        out = f"alone{number}"
        evaluation = [f"evaluate={run}", f"dataset.root={single}", f"out={out}", "pictures=0"]
        status, _, err = call(evaluation, tmp_path)
        assert status == 0, err
        (result,) = (tmp_path / out).rglob("result.json")
        alone.append(read_record(result.parent).metrics)

    for name in ("test/generated/accuracy", "test/completed/accuracy", "test/loss/cross_entropy"):
        values = [metrics[name] for metrics in alone]
        assert together[name] == pytest.approx(np.mean(values), rel=1e-5)


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        (["dataset.crop=nearest"], "n_points must be a number with crop=nearest"),
        (["task=reconstruction"], "dataset.n_points must be a number with task/net=autoencoder:"),
        (["test_corruption=jitter-1"], "test_corruption=jitter-1 needs clouds of one size"),
        (["m=41"], "m must be at most the 40 points of a cloud"),
    ],
)
def test_run_on_clouds_of_different_sizes_refuses_what_needs_one_size(
    chosen, message, folder, tmp_path
):
    err = refused([*RUN, "sampler=fps", *chosen], tmp_path)

    assert message in err


def test_corrupt_clouds_of_different_sizes_is_refused(folder):
    clouds = dataset_of(folder).test

    with pytest.raises(UserError, match="needs clouds of one size"):
        corrupt(clouds, "shear-3")
