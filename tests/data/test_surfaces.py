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


TWO_TRIANGLES = """\
OFF
6 2 0
0 0 5
3 0 5
0 3 5
9 0 5
10 0 5
9 1 5
3 0 1 2
3 3 4 5
"""
"""A big and a small triangle in the plane z = 5: 90 % and 10 % of the area."""


def test_sample_surface_is_uniform_by_area(tmp_path):
    path = tmp_path / "two.off"
    path.write_text(TWO_TRIANGLES)

    _, sampled = sample_surface(path, 10_000, seed=0)

    points = sampled.numpy()
    assert np.ptp(points[:, 2]) == 0
    assert len(np.unique(points, axis=0)) == 10_000
    x = points[:, 0]
    along = (x - x.min()) / np.ptp(x)
    share_of_small = (along > 0.6).mean()
    assert abs(share_of_small - 0.1) < 0.012  # four standard deviations


def test_sampling_cloud_depends_on_content_and_seed(mesh_layout, tmp_path):
    elsewhere = shutil.copytree(mesh_layout, tmp_path / "elsewhere")
    write_mesh(elsewhere / "ball" / "train" / "ball_0.off", BALL)
    state = repr(np.random.get_state())  # noqa: NPY002

    first = meshes(mesh_layout, n_points=50).train.points
    state_after = repr(np.random.get_state())  # noqa: NPY002
    again = meshes(elsewhere, n_points=50).train.points
    other = meshes(mesh_layout, n_points=50, seed=1).train.points

    assert state_after == state
    assert torch.equal(again[1:], first)
    is_equal = torch.isclose(other, first).all(-1)
    assert not is_equal.any()
    # Files with the same shape at different scales have different samples.
    assert not torch.allclose(first[1], first[2], atol=1e-3)


def test_sampling_fingerprint_depends_on_content_names_and_arguments(mesh_layout, tmp_path):
    def fingerprint(folder, n_points=20, **more):
        return meshes(folder, n_points=n_points, **more).fingerprint

    elsewhere = shutil.copytree(mesh_layout, tmp_path / "elsewhere")
    boxes = elsewhere / "box" / "train"
    first = fingerprint(mesh_layout)
    of_copy = fingerprint(elsewhere, cache=tmp_path / "cache")
    more_points = fingerprint(mesh_layout, n_points=21)
    other_seed = fingerprint(mesh_layout, seed=1)
    one_class = fingerprint(mesh_layout, classes=["box"])
    (boxes / "box_1.off").rename(boxes / "new.off")
    other_name = fingerprint(elsewhere)
    write_mesh(boxes / "new.off", BALL)
    other_content = fingerprint(elsewhere)

    assert of_copy == first
    different = {first, more_points, other_seed, one_class, other_name, other_content}
    assert len(different) == 6


def add_one(path):
    """Change the points that a file of a cache holds."""
    points = np.load(path)["arr_0"]
    np.savez(path, points + np.float32(1))


def test_sampling_cache_depends_on_content_and_arguments(mesh_layout, tmp_path):
    cache = tmp_path / "new" / "cache"
    moved = tmp_path / "moved"
    first = meshes(mesh_layout, n_points=20, cache=cache)
    kept = sorted(cache.iterdir())
    (cache / f"{TEMPORARY}left by a kill.npz").touch()
    for path in kept:
        add_one(path)
    shutil.move(mesh_layout, moved)

    from_cache = meshes(moved, n_points=20, cache=str(cache))
    meshes(moved, n_points=21, cache=cache)
    meshes(moved, n_points=20, cache=cache, seed=1)
    write_mesh(moved / "box" / "train" / "box_1.off", BALL)
    changed = meshes(moved, n_points=20, cache=cache)

    assert [path.suffix for path in kept] == [".npz"] * 5
    assert torch.equal(from_cache.train.points, first.train.points + 1)
    assert from_cache.fingerprint == first.fingerprint
    assert len(list(cache.iterdir())) == 16
    radii_of_changed = changed.train.points[1].norm(dim=1)
    assert radii_of_changed.max() < 1.001
