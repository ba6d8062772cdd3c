from functools import partial
from pathlib import Path, PurePath, PurePosixPath
from typing import Any

import numpy as np
import pytest
import torch
from trimesh.creation import box

from mops_lightning.data import cloud_folder as module
from mops_lightning.data.cloud_folder import random_crops
from mops_lightning.data.formats.guard import BadCloudError
from mops_lightning.data.formats.registry import WRITERS
from mops_lightning.data.formats.table import Table
from mops_lightning.errors import UserError
from tests.support.meshes import write_mesh

cloud_folder = partial(module.cloud_folder, test_frames=None, crop="nearest", crops=32)

FORMATS = (".ply", ".pcd", ".bin", ".npy", ".npz", ".xyz", ".txt")


def write(path, seed=0, number=300):
    path.parent.mkdir(parents=True, exist_ok=True)
    points = np.random.default_rng(seed).normal(size=(number, 3)) * [3, 2, 1] + 50
    WRITERS[path.suffix](path, Table(points))


@pytest.fixture
def folder(tmp_path):
    """One cloud per format, and a mesh."""
    for seed, suffix in enumerate(FORMATS):
        write(tmp_path / f"scan_{seed}{suffix}", seed)
    write_mesh(tmp_path / "box.stl", box())
    return tmp_path


def test_cloud_folder_reads_every_format_without_labels_and_each_file_for_one_split(folder):
    data = cloud_folder(folder, n_points=64, crops=3)
    assert data.class_names == ("cloud",)
    assert data.train.points.shape == (18, 64, 3)
    assert data.test.points.shape == (6, 64, 3)
    assert (data.notes["train_files"], data.notes["test_files"]) == (6, 2)
    assert torch.isfinite(data.train.points).all()
    assert data.train.points.norm(dim=2).amax(1).allclose(torch.ones(18))
    assert data.train.points.mean(1).abs().max() < 1e-5
    sources: list[Any] = [data.train.sources, data.test.sources]
    train, test = sources
    assert train.bincount()[train.unique()].eq(3).all()
    assert not set(train.tolist()) & set(test.tolist())


def test_cloud_folder_crops_do_not_depend_on_other_files(folder):
    everything = cloud_folder(folder, n_points=64, crops=2, crop="whole")
    (folder / "scan_3.npy").unlink()
    fewer = cloud_folder(folder, n_points=64, crops=2, crop="whole")
    clouds = torch.cat([everything.train.points, everything.test.points])
    for cloud in torch.cat([fewer.train.points, fewer.test.points]):
        assert (clouds == cloud).all(2).all(1).any()
    assert fewer.fingerprint != everything.fingerprint


def test_cloud_folder_folders_are_classes_and_splits(tmp_path):
    for seed, name in enumerate(("tree/train/a", "tree/test/b", "car/train/c", "car/test/d")):
        write(tmp_path / f"{name}.ply", seed)
    data = cloud_folder(tmp_path, n_points=32, crops=2)
    assert data.class_names == ("car", "tree")
    assert data.train.labels.tolist() == data.test.labels.tolist() == [0, 0, 1, 1]
    assert cloud_folder(tmp_path, n_points=32, classes=["car"]).class_names == ("car",)


def test_cloud_folder_broken_file_is_named(folder):
    (folder / "notes.txt").write_text("scanned on Monday\n")
    with pytest.raises(UserError, match=r"notes\.txt"):
        cloud_folder(folder, n_points=64)
    (folder / "notes.txt").unlink()
    write(folder / "small.ply", number=10)
    with pytest.raises(UserError, match=r"small\.ply has 10 points, fewer .*or remove the file"):
        cloud_folder(folder, n_points=64)


def test_cloud_folder_class_in_one_split_is_reported(mesh_layout, capsys):
    (mesh_layout / "ball" / "test" / "ball_3.OFF").unlink()
    data = cloud_folder(mesh_layout, n_points=20, crop="surface", crops=1)
    assert data.notes["classes_without_test_files"] == ["ball"]
    assert "no test file of ball: never scored" in capsys.readouterr().err


def test_cloud_folder_surface_reads_modelnet_layout(mesh_layout, capsys):
    data = cloud_folder(mesh_layout, n_points=200, crop="surface", crops=1)
    assert data.class_names == ("ball", "box")
    assert data.train.labels.tolist() == [0, 1, 1]
    assert data.test.labels.tolist() == [0, 1]
    assert data.notes == {"train_files": 3, "test_files": 2}
    for clouds in (data.train, data.test):
        assert clouds.points.shape == (len(clouds.labels), 200, 3)
        assert (clouds.points.dtype, clouds.labels.dtype) == (torch.float32, torch.int64)
        torch.testing.assert_close(clouds.points.mean(1), torch.zeros(len(clouds.labels), 3))
        farthest = clouds.points.norm(dim=2).amax(1)
        torch.testing.assert_close(farthest, torch.ones(len(clouds.labels)))
    assert capsys.readouterr() == ("", "")  # no progress bar without a terminal


def test_cloud_folder_splits_every_class_by_share(tmp_path):
    """ShapeNetCore's layout: SYNSET/*.ply, objects that overlap each other."""
    for synset, number in (("02691156", 20), ("03001627", 5), ("alone", 1)):
        for i in range(number):
            write(tmp_path / synset / f"{i:032x}.ply", seed=i, number=60)
    settings: dict[str, Any] = {"n_points": 50, "crop": "whole", "crops": 1, "test_share": 0.15}
    data = cloud_folder(tmp_path, **settings)
    assert data.class_names == ("02691156", "03001627", "alone")
    assert data.train.points.shape == (17 + 4 + 1, 50, 3)
    assert data.test.labels.tolist() == [0] * 3 + [1]
    assert data.train.sources is None
    again, other = (cloud_folder(tmp_path, **settings, seed=seed) for seed in (0, 1))
    assert again.fingerprint == data.fingerprint != other.fingerprint
    assert torch.equal(again.test.points, data.test.points)


def test_cloud_folder_splits_sequences_by_time(tmp_path):
    """Two sequences of boxes that grow with time; frame numbers are not padded."""
    for name, frames in (("crane", 12), ("samba", 10)):
        for frame in range(frames):
            write_mesh(tmp_path / name / f"mesh_{frame}.ply", box((1, 1, 1 + frame)))
        (tmp_path / name / "notes.txt").write_text("no mesh")
    by_time: dict[str, Any] = {"test_frames": "last", "test_share": 0.25, "gap": 2}
    data = cloud_folder(tmp_path, 3000, crop="surface", crops=1, **by_time)
    assert data.class_names == ("crane", "samba")
    found = []
    for clouds in (data.test, data.train):
        size = clouds.points.amax(1) - clouds.points.amin(1)
        times = (size[:, 2] / size[:, 0] - 1).round().int()
        found += [sorted(times[clouds.labels == label].tolist()) for label in (0, 1)]
    assert found == [[9, 10, 11], [8, 9], list(range(7)), list(range(6))]


def test_cloud_folder_real_sequences(real_data):
    root = real_data("vlasic2008")
    data = cloud_folder(root, 64, test_frames="last", gap=2, crop="surface", crops=1)
    assert data.class_names == ("crane", "samba")
    assert len(data.test.labels) == 24
    assert len(data.train.labels) == 2 * (59 - 12 - 2)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"crop": "near"}, "crop: unknown 'near'.*'nearest'"),
        ({"crop": "surface"}, "crops must be 1 with crop=surface, got 32"),
        ({"test_share": 1.0}, "test_share must be between 0 and 1, got 1.0"),
        ({"test_frames": "lats"}, "test_frames must be last or null, got 'lats'"),
        ({"crops": 0}, "crops must be at least 1"),
        ({"n_points": 0}, "n_points must be at least 2, got 0"),
        ({"gap": -1}, "gap must be at least 0, got -1"),
        ({"seed": -1}, "seed must be at least 0, got -1"),
        ({"classes": ["clod"]}, "classes: unknown class 'clod'.*cloud"),
    ],
)
def test_cloud_folder_invalid_argument_raises(folder, settings, message):
    with pytest.raises(UserError, match=f"^{message}"):
        cloud_folder(folder, **{"n_points": 64, **settings})


def test_cloud_folder_without_cloud_raises(tmp_path):
    with pytest.raises(UserError, match=r"^root: no file in .*\.ply"):
        cloud_folder(tmp_path)
    with pytest.raises(UserError, match=r"^root: no file in or below .*none ends in"):
        cloud_folder(tmp_path / "none")


PATH = Path("scan.ply")
FAR = np.array([431_000.0, 5_412_000.0, 120.0])


def cloud(number=2000, side=10.0):
    return np.random.default_rng(0).uniform(0, side, (number, 3)) + FAR


def draw(points, crop="nearest", n_points=50, number=6, seed=1):
    rng = np.random.default_rng(seed)
    return random_crops(points, n_points, number, crop, rng, PATH)[0]


def test_random_crops_nearest_is_a_ball_around_a_point():
    points = cloud()
    crops = draw(points)
    assert crops.shape == (6, 50, 3)
    assert np.abs(crops.mean(1)).max() < 1e-5
    first = points[np.random.default_rng(1).integers(len(points))]
    distances = np.sort(np.linalg.norm(points - first, axis=1))[:50]
    near = points[np.linalg.norm(points - first, axis=1) <= distances[-1]]
    assert np.allclose(crops[0], near - near.mean(0), atol=1e-5)


def test_random_crops_whole():
    points = cloud()
    whole = draw(points, "whole", n_points=1000, number=2)
    assert np.ptp(whole, axis=1).min() > 9
    assert not np.array_equal(whole[0], whole[1])
    assert len(np.unique(whole[0], axis=0)) == 1000


def test_random_crops_of_coincident_points_raises():
    with pytest.raises(BadCloudError, match="the 50 points of a crop coincide"):
        draw(np.ones((60, 3)), "whole")


def paths(*names):
    return [PurePosixPath(name) for name in names]


def test_split_by_folder_first_or_second_folder():
    names = paths("train/a.ply", "chair/test/b.ply", "train/chair/deep/c.ply")
    assert module.split_by_folder(names) == ["train", "test", "train"]
    assert [module.class_of(name) for name in names] == ["cloud", "chair", "chair"]
    assert module.split_by_folder(paths("a.ply", "chair/b.ply")) is None
    with pytest.raises(UserError, match=r"chair/b\.ply is neither in train/ nor in test/"):
        module.split_by_folder(paths("train/a.ply", "chair/b.ply"))


def test_split_by_share_depends_on_the_seed():
    names = paths(*(f"a/{i}.ply" for i in range(10)))
    first, again, other = (module.split_by_share(names, 0.3, seed) for seed in (0, 0, 1))
    assert first == again != other


def test_by_number_sorts_digits_that_are_no_numbers():
    names = ["f_10", "f_9", "1²", "²"]
    ordered = sorted((PurePath(f"{name}.ply") for name in names), key=module.by_number)
    assert [path.stem for path in ordered] == ["1²", "f_9", "f_10", "²"]


FRAMES = paths(*(f"crane/{i}.ply" for i in range(12)), *(f"samba/{i}.ply" for i in range(10)))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ((0.2, 10), r"^gap must .*, got 10: crane has 12 frame.*2 of them.* below 10, or"),
        ((0.99, 2), r"crane has 12 frame.*12 of them.* smaller test_share"),
    ],
)
def test_split_by_time_invalid_argument_raises(settings, message):
    with pytest.raises(UserError, match=message):
        module.split_by_time(FRAMES, *settings)
