"""Sampling lists of meshes, called through ``meshes``."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from mops_lightning.data.meshes import meshes
from mops_lightning.errors import UserError
from mops_lightning.filesystem import TEMPORARY
from tests.support.meshes import BALL, write_mesh


def test_sampling_class_in_one_split_is_reported(
    mesh_layout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (mesh_layout / "ball" / "test" / "ball_3.OFF").unlink()
    dataset = meshes(mesh_layout, n_points=20)
    assert dataset.notes["classes_without_test_meshes"] == ["ball"]
    assert "no test mesh of ball: never scored" in capsys.readouterr().err


def test_sampling_broken_mesh_raises_or_is_skipped(mesh_layout: Path) -> None:
    whole = meshes(mesh_layout, n_points=20)
    (mesh_layout / "ball" / "train" / "a.off").write_bytes(b"OFF\n")
    (mesh_layout / "box" / "test" / "b.stl").write_bytes(b"")
    with pytest.raises(UserError, match=r"a\.off is broken.*dataset\.skip_broken=true"):
        meshes(mesh_layout, n_points=20)
    dataset = meshes(mesh_layout, n_points=20, skip_broken=True)
    assert dataset.notes == {"skipped_meshes": 2}
    assert torch.equal(dataset.train.points, whole.train.points)
    assert torch.equal(dataset.test.labels, whole.test.labels)


def test_sampling_split_without_mesh_raises(mesh_layout: Path) -> None:
    for path in mesh_layout.glob("*/test/*"):
        path.write_bytes(b"")
    with pytest.raises(UserError, match=r"no test mesh of ball, box .*2 broken meshes"):
        meshes(mesh_layout, n_points=20, skip_broken=True)


def test_sampling_cloud_depends_on_content_and_seed(mesh_layout: Path, tmp_path: Path) -> None:
    before = repr(np.random.get_state())  # noqa: NPY002
    first = meshes(mesh_layout, n_points=50)
    assert repr(np.random.get_state()) == before  # noqa: NPY002
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(mesh_layout, elsewhere)
    write_mesh(elsewhere / "ball" / "train" / "ball_0.off", BALL)
    again = meshes(elsewhere, n_points=50)
    assert torch.equal(again.train.points[1:], first.train.points)
    other = meshes(mesh_layout, n_points=50, seed=1)
    assert not torch.isclose(other.train.points, first.train.points).all(-1).any()
    # Files with the same shape at different scales have different samples.
    assert not torch.allclose(first.train.points[1], first.train.points[2], atol=1e-3)


def test_sampling_fingerprint_depends_on_content_names_and_arguments(
    mesh_layout: Path, tmp_path: Path
) -> None:
    first = meshes(mesh_layout, n_points=20).fingerprint
    elsewhere = shutil.copytree(mesh_layout, tmp_path / "elsewhere")
    assert meshes(elsewhere, n_points=20, cache=tmp_path / "cache").fingerprint == first
    prints = {
        first,
        meshes(mesh_layout, n_points=21).fingerprint,
        meshes(mesh_layout, n_points=20, seed=1).fingerprint,
        meshes(mesh_layout, n_points=20, classes=["box"]).fingerprint,
    }
    (elsewhere / "box" / "train" / "box_1.off").rename(elsewhere / "box" / "train" / "new.off")
    prints.add(meshes(elsewhere, n_points=20).fingerprint)
    write_mesh(elsewhere / "box" / "train" / "new.off", BALL)
    prints.add(meshes(elsewhere, n_points=20).fingerprint)
    assert len(prints) == 6


def test_sampling_cache_depends_on_content_and_arguments(mesh_layout: Path, tmp_path: Path) -> None:
    cache = tmp_path / "new" / "cache"
    first = meshes(mesh_layout, n_points=20, cache=cache)
    kept = sorted(cache.iterdir())
    assert [path.suffix for path in kept] == [".npy"] * 5
    for path in kept:  # the result comes from the cache
        np.save(path, np.load(path) + np.float32(1))
    shutil.move(mesh_layout, tmp_path / "moved")
    again = meshes(tmp_path / "moved", n_points=20, cache=str(cache))
    assert torch.equal(again.train.points, first.train.points + 1)
    assert again.fingerprint == first.fingerprint
    meshes(tmp_path / "moved", n_points=21, cache=cache)
    meshes(tmp_path / "moved", n_points=20, cache=cache, seed=1)
    write_mesh(tmp_path / "moved" / "box" / "train" / "box_1.off", BALL)
    changed = meshes(tmp_path / "moved", n_points=20, cache=cache)
    assert len(list(cache.iterdir())) == 16
    assert changed.train.points[1].norm(dim=1).max() < 1.001


@pytest.mark.parametrize("damage", [b"", b"\x93NUMPY\x01\x00", b"noise" * 100])
def test_sampling_damaged_cache_is_replaced(
    mesh_layout: Path, tmp_path: Path, damage: bytes
) -> None:
    first = meshes(mesh_layout, n_points=20, cache=tmp_path / "cache")
    kept = {path: path.read_bytes() for path in (tmp_path / "cache").iterdir()}
    for path in kept:
        path.write_bytes(damage)
    (tmp_path / "cache" / f"{TEMPORARY}left by a kill.npy").touch()
    again = meshes(mesh_layout, n_points=20, cache=tmp_path / "cache")
    assert torch.equal(again.train.points, first.train.points)
    assert {path: path.read_bytes() for path in (tmp_path / "cache").iterdir()} == kept


def test_sampling_unwritable_cache_raises(mesh_layout: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"^cache: cannot write"):
        meshes(mesh_layout, n_points=20, cache=tmp_path / "file", skip_broken=True)


def test_sampling_workers_give_same_result(mesh_layout: Path) -> None:
    (mesh_layout / "ball" / "train" / "a.off").write_bytes(b"OFF\n")
    one = meshes(mesh_layout, n_points=20, skip_broken=True)
    two = meshes(mesh_layout, n_points=20, skip_broken=True, workers=2)
    assert torch.equal(one.train.points, two.train.points)
    assert torch.equal(one.test.points, two.test.points)
    assert one.fingerprint == two.fingerprint
    assert one.notes == two.notes == {"skipped_meshes": 1}
