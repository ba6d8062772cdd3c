"""The clouds on which a task net is scored."""

from dataclasses import replace

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
        columns = {
            "intensity": np.where(is_left, 150.0, 75.0).astype(np.float32),
            "part": np.where(is_left, 2, 5).astype(np.int32),
        }
        paths.append(tmp_path / f"{number}.ply")
        write_cloud(paths[-1], points, columns)
    return paths


def subject(**changes):
    of_module = subject_of_module(nn.Identity(), lambda output, batch: output, 64, 2, None)
    return replace(of_module, **changes)


def drawn(sources, chosen, seed=0):
    return {
        half: [batch for batch, _ in batches(sources, chosen, half, seed)]
        for half in (CHOOSING, CHECKING)
    }


def test_batches_have_channels_and_parts_of_the_same_points(files):
    channels = PointChannels([Channel("intensity", 100.0, 25.0)])
    chosen = subject(channels=channels, label="part", outputs=("5", "2"))

    sources = read_sources(files, chosen, 0, None)

    by_half = drawn(sources, chosen)
    clouds = [batch for half in by_half.values() for batch in half]
    assert [len(batch.points) for batch in clouds] == [4, 2]  # two crops of two files, and of one
    for batch in clouds:
        scaled = batch.points[..., 3]
        assert set(scaled.unique().tolist()) == {-1.0, 2.0}  # (75 - 100) / 25, (150 - 100) / 25
        assert torch.equal(batch.parts, torch.where(scaled == 2.0, 1, 0))
        lengths = batch.points[..., :3].norm(dim=2).amax(1)
        assert torch.allclose(lengths, torch.ones(len(lengths)))


def test_batches_of_another_seed_are_other_clouds(files):
    sources = read_sources(files, subject(), 0, None)

    first, same, other = (drawn(sources, subject(), seed)[CHECKING][0] for seed in (0, 0, 1))

    assert torch.equal(first.points, same.points)
    assert not torch.equal(first.points, other.points)


def test_parts_with_names_are_numbered_from_zero(files):
    names = tuple("abcdef")

    sources = read_sources(files, subject(label="part", outputs=names), 0, None)

    assert sources[0].parts is not None
    assert set(sources[0].parts.tolist()) == {2, 5}


def test_file_without_the_channel_is_refused(files):
    chosen = subject(channels=PointChannels([Channel("reflectance", 0.0, 1.0)]))

    with pytest.raises(UserError, match=r"--task-net: .*0\.ply has no column 'reflectance'"):
        read_sources(files, chosen, 0, None)


def test_halves_share_the_files_of_every_class(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        for number in range(4):
            np.save(tmp_path / name / f"{number}.npy", uniform_points(70, number))
    files = sorted(tmp_path.rglob("*.npy"))

    sources = read_sources(files, subject(), 0, None)

    for label in (0, 1):
        halves = [source.half for source in sources if source.label == label]
        assert halves.count(CHOOSING) == halves.count(CHECKING) == 2
