"""Sampling the surfaces of meshes, called through ``cloud_folder``."""

import shutil
from functools import partial

import numpy as np
import torch

from mops_lightning.data.cloud_folder import cloud_folder
from mops_lightning.data.surfaces import sample_surface
from mops_lightning.filesystem import TEMPORARY
from tests.support.meshes import BALL, write_mesh

meshes = partial(cloud_folder, test_frames=None, crop="surface", crops=1)


def test_sample_surface_is_uniform_by_area(tmp_path):
    # A big and a small triangle in the plane z = 5: 90 % and 10 % of the area.
    text = "OFF\n6 2 0\n0 0 5\n3 0 5\n0 3 5\n9 0 5\n10 0 5\n9 1 5\n3 0 1 2\n3 3 4 5\n"
    (tmp_path / "two.off").write_text(text)
    points = sample_surface(tmp_path / "two.off", 10_000, seed=0)[1].numpy()
    assert np.ptp(points[:, 2]) == 0
    small = points[:, 0] > points[:, 0].min() + 0.6 * np.ptp(points[:, 0])
    assert abs(small.mean() - 0.1) < 0.012  # four standard deviations
    assert len(np.unique(points, axis=0)) == 10_000


def test_sampling_cloud_depends_on_content_and_seed(mesh_layout, tmp_path):
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


def test_sampling_fingerprint_depends_on_content_names_and_arguments(mesh_layout, tmp_path):
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


def test_sampling_cache_depends_on_content_and_arguments(mesh_layout, tmp_path):
    cache = tmp_path / "new" / "cache"
    first = meshes(mesh_layout, n_points=20, cache=cache)
    kept = sorted(cache.iterdir())
    assert [path.suffix for path in kept] == [".npz"] * 5
    (cache / f"{TEMPORARY}left by a kill.npz").touch()
    for path in kept:  # the result comes from the cache
        np.savez(path, np.load(path)["arr_0"] + np.float32(1))
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
