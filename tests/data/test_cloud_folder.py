import numpy as np
import pytest
import torch
import trimesh

from mops_lightning.data.cloud_folder import cloud_folder
from mops_lightning.data.formats.registry import WRITERS
from mops_lightning.data.formats.table import Table
from mops_lightning.errors import UserError

FORMATS = (".ply", ".pcd", ".bin", ".npy", ".npz", ".xyz", ".txt", ".obj")


def write(path, seed=0, number=300):
    path.parent.mkdir(parents=True, exist_ok=True)
    points = np.random.default_rng(seed).normal(size=(number, 3)) * [3, 2, 1] + 50
    WRITERS[path.suffix](path, Table(points))


@pytest.fixture
def folder(tmp_path):
    """One cloud per format, and a mesh."""
    for seed, suffix in enumerate(FORMATS):
        write(tmp_path / f"scan_{seed}{suffix}", seed)
    trimesh.creation.box().export(tmp_path / "box.stl")
    return tmp_path


def test_cloud_folder_reads_every_format_without_labels(folder):
    data = cloud_folder(folder, n_points=64, crops=3)
    assert data.class_names == ("cloud",)
    assert data.train.points.shape == (21, 64, 3)
    assert data.test.points.shape == (6, 64, 3)
    assert (data.notes["train_files"], data.notes["test_files"]) == (7, 2)
    assert torch.isfinite(data.train.points).all()
    assert data.train.points.norm(dim=2).amax(1).allclose(torch.ones(21))
    assert data.train.points.mean(1).abs().max() < 1e-5


def test_cloud_folder_file_is_in_one_split(folder):
    data = cloud_folder(folder, n_points=64, crops=3)
    train, test = data.train.sources, data.test.sources
    assert train is not None
    assert test is not None
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


def test_cloud_folder_split_file(folder):
    (folder / "split.csv").write_text("path,split\nscan_0.ply,test\nscan_1.pcd,train\n")
    data = cloud_folder(folder, n_points=64, crops=2, split_file="split.csv")
    assert (len(data.train.points), len(data.test.points)) == (2, 2)


def test_cloud_folder_broken_file_named_or_skipped(folder):
    (folder / "notes.txt").write_text("scanned on Monday\n")
    write(folder / "small.ply", number=10)
    with pytest.raises(UserError, match=r"notes\.txt.*skip_broken=true"):
        cloud_folder(folder, n_points=64)
    data = cloud_folder(folder, n_points=64, crops=1, skip_broken=True)
    assert data.notes["skipped_files"] == 2
    assert data.notes["train_files"] + data.notes["test_files"] == 9


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"crop": "cubes"}, "crop: unknown 'cubes'.*'cube'"),
        ({"crop": "cube"}, "crop_size.*crop=cube"),
        ({"crop_size": 2.0}, "crop_size.*crop=nearest"),
        ({"crop": "cube", "crop_size": -1.0}, "crop_size must be above 0"),
        ({"test_share": 1.0}, "test_share"),
        ({"surface": 0}, "surface"),
        ({"crops": 0}, "crops must be at least 1"),
    ],
)
def test_cloud_folder_invalid_argument_raises(tmp_path, settings, message):
    with pytest.raises(UserError, match=message):
        cloud_folder(tmp_path, **settings)


def test_cloud_folder_without_cloud_raises(tmp_path):
    with pytest.raises(UserError, match=r"root: no cloud in .*\.ply"):
        cloud_folder(tmp_path)
