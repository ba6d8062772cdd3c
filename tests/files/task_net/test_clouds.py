"""The clouds on which a task net is scored."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from mops_lightning.channels import Channel, PointChannels
from mops_lightning.errors import UserError
from mops_lightning.files.task_net.clouds import CHECKING, CHOOSING, batches, read_sources
from mops_lightning.files.task_net.subject import subject_of_module
from tests.support.cloud_files import write_cloud
from tests.support.clouds import uniform_points


@pytest.fixture
def files(tmp_path):
    """Three files whose intensity is 150 to the left, 75 to the right, with parts 2 and 5."""
    random = np.random.default_rng(0)
    paths = []
    for number in range(3):
        points = random.random((90, 3))
        points[:, 0] += 500_000
        is_left = points[:, 1] < 0.5
        intensity = np.where(is_left, 150.0, 75.0)
        part = np.where(is_left, 2, 5)
        columns: dict[str, Any] = {
            "intensity": intensity.astype(np.float32),
            "part": part.astype(np.int32),
        }
        path = tmp_path / f"{number}.ply"
        paths.append(path)
        write_cloud(path, points, columns)
    return paths


def subject(**changes):
    of_module = subject_of_module(nn.Identity(), lambda output, batch: output, 64, 2, None)
    return replace(of_module, **changes)


def drawn(sources, chosen, half, seed=0):
    """Return the batches of a half of the files."""
    return [batch for batch, _ in batches(sources, chosen, half, seed)]


def test_batches_have_channels_and_parts_of_the_same_points(files):
    channels = PointChannels([Channel("intensity", 100.0, 25.0)])
    chosen = subject(channels=channels, label="part", outputs=("5", "2"))

    sources = read_sources(files, chosen, 0, None)

    (of_two_files,) = drawn(sources, chosen, CHOOSING)
    (of_one_file,) = drawn(sources, chosen, CHECKING)
    assert len(of_two_files.points) == 4  # two crops each
    assert len(of_one_file.points) == 2
    right = (75 - 100) / 25
    left = (150 - 100) / 25
    for batch in (of_two_files, of_one_file):
        scaled = batch.points[..., 3]
        parts = (scaled == left).long()
        assert scaled.unique().tolist() == [right, left]
        assert torch.equal(batch.parts, parts)
        lengths = batch.points[..., :3].norm(dim=2).amax(1)
        assert torch.allclose(lengths, torch.ones(len(lengths)))


def test_batches_of_another_seed_are_other_clouds(files):
    chosen = subject()
    sources = read_sources(files, chosen, 0, None)

    (first,) = drawn(sources, chosen, CHECKING, seed=0)
    (same,) = drawn(sources, chosen, CHECKING, seed=0)
    (other,) = drawn(sources, chosen, CHECKING, seed=1)

    assert torch.equal(first.points, same.points)
    assert not torch.equal(first.points, other.points)


def test_parts_with_names_are_numbered_from_zero(files):
    names = tuple("abcdef")
    chosen = subject(label="part", outputs=names)

    first, *_ = read_sources(files, chosen, 0, None)

    assert first.parts is not None
    assert set(first.parts.tolist()) == {2, 5}


def test_file_without_the_channel_is_refused(files):
    channels = PointChannels([Channel("reflectance", 0.0, 1.0)])
    chosen = subject(channels=channels)

    with pytest.raises(UserError, match=r"--task-net: .*0\.ply has no column 'reflectance'"):
        read_sources(files, chosen, 0, None)


def test_halves_share_the_files_of_every_class(tmp_path):
    for name in ("a", "b"):
        folder = tmp_path / name
        folder.mkdir()
        for number in range(4):
            points = uniform_points(70, number)
            np.save(folder / f"{number}.npy", points)
    files = sorted(tmp_path.rglob("*.npy"))

    sources = read_sources(files, subject(), 0, None)

    for label in (0, 1):
        halves = [source.half for source in sources if source.label == label]
        assert halves.count(CHOOSING) == 2
        assert halves.count(CHECKING) == 2


def test_class_of_a_file_is_the_nearest_folder_that_is_one(tmp_path):
    classes = ("tall", "flat", "round")
    net = nn.Identity()
    of_classes = replace(subject(outputs=classes), task=with_outputs(net, "class_names"))
    folder = tmp_path / "flat" / "tall" / "scans"
    folder.mkdir(parents=True)
    np.save(folder / "a.npy", uniform_points(70, 0))

    (source,) = read_sources([folder / "a.npy"], of_classes, 0, None)

    assert source.label == 0


def with_outputs(net, names):
    """Return a task whose net tells classes or parts apart."""
    task = subject_of_module(net, lambda output, batch: output, 64, 2, None).task
    task.output_names = names
    return task


def test_classes_of_a_module_are_the_folders_in_alphabetical_order(tmp_path):
    paths = []
    for name in ("tall", "flat", "round"):
        (tmp_path / name).mkdir()
        paths.append(tmp_path / name / "a.npy")
        np.save(paths[-1], uniform_points(70, 0))

    sources = read_sources(paths, subject(), 0, None)

    assert [source.label for source in sources] == [2, 0, 1]


def test_columns_name_those_of_bin_files_and_points_that_are_not_finite_are_left_out(tmp_path):
    path = tmp_path / "a.bin"
    points = uniform_points(80, 0).astype(np.float32)
    points[:10] = np.nan
    np.insert(points, 0, 7.0, axis=1).tofile(path)

    (source,) = read_sources([path], subject(), 0, ("i", "x", "y", "z"))

    assert np.array_equal(source.points, points[10:].astype(np.float64))


def test_halves_depend_on_the_seed(tmp_path):
    paths = []
    for number in range(8):
        paths.append(tmp_path / f"{number}.npy")
        np.save(paths[-1], uniform_points(70, number))

    halves = set()
    for seed in range(4):
        sources = read_sources(paths, subject(), seed, None)
        halves.add(tuple(source.half for source in sources))

    assert len(halves) > 1
