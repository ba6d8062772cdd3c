"""Readers of ShapeNet, on small files with the layouts of the public archives."""

import json
from typing import Any

import h5py
import numpy as np
import pytest
import torch
import trimesh

from mops_lightning.data.shapenet import shapenet_core, shapenet_part
from mops_lightning.errors import UserError

PLANE, CHAIR = "02691156", "03001627"


@pytest.fixture
def core(tmp_path):
    """shape_net_core_uniform_samples_2048: binary PLY clouds, one folder per synset."""
    rng = np.random.default_rng(0)
    for synset, number in ((PLANE, 20), (CHAIR, 5)):
        (tmp_path / synset).mkdir()
        for i in range(number):
            cloud = trimesh.PointCloud(rng.normal(size=(60, 3)) + 5)
            cloud.export(tmp_path / synset / f"{i:032x}.ply")
    return tmp_path


def test_shapenet_core_splits_by_class(core):
    data = shapenet_core(core, n_points=50)
    assert data.class_names == (PLANE, CHAIR)
    assert data.train.points.shape == (17 + 4, 50, 3)
    assert data.test.labels.tolist() == [0] * 3 + [1]
    assert data.train.points.norm(dim=2).amax(1).allclose(torch.ones(21))
    assert data.train.points.mean(1).abs().max() < 1e-5
    # No cloud is in both splits.
    assert torch.cdist(data.train.points.flatten(1), data.test.points.flatten(1)).min() > 0.1
    again = shapenet_core(core, n_points=50)
    assert again.fingerprint == data.fingerprint
    assert torch.equal(again.test.points, data.test.points)
    other = shapenet_core(core, n_points=50, seed=1)
    assert other.fingerprint != data.fingerprint


def test_shapenet_core_without_normalisation(core):
    data = shapenet_core(core, n_points=60, classes=[CHAIR], normalize=False)
    assert data.class_names == (CHAIR,)
    stored: list[Any] = [trimesh.load(path) for path in (core / CHAIR).glob("*.ply")]
    first = {tuple(np.asarray(cloud.vertices, np.float32)[0].tolist()) for cloud in stored}
    read = torch.cat([data.train.points, data.test.points])[:, 0]
    assert {tuple(row) for row in read.tolist()} == first


CATEGORIES = "Airplane\t02691156\nChair\t03001627\n"


@pytest.fixture
def part_hdf5(tmp_path):
    rng = np.random.default_rng(0)
    (tmp_path / "all_object_categories.txt").write_text(CATEGORIES)
    for name, number in (("train0", 4), ("train1", 3), ("val0", 2), ("test0", 3)):
        with h5py.File(tmp_path / f"ply_data_{name}.h5", "w") as file:
            file["data"] = rng.normal(size=(number, 64, 3)).astype(np.float32)
            file["label"] = (np.arange(number) % 2).astype(np.uint8)[:, None]
            file["pid"] = np.zeros((number, 64), np.uint8)
    return tmp_path


def test_part_hdf5_trains_on_training_and_validation_clouds(part_hdf5):
    data = shapenet_part(part_hdf5, n_points=32)
    assert data.class_names == ("Airplane", "Chair")
    assert len(data.train.labels) == 4 + 3 + 2
    assert len(data.test.labels) == 3
    with h5py.File(part_hdf5 / "ply_data_test0.h5") as file:
        stored = torch.from_numpy(file["data"][:, :32])
    plain = shapenet_part(part_hdf5, n_points=32, normalize=False)
    assert torch.equal(plain.test.points, stored)
    assert shapenet_part(part_hdf5, 32, ["Chair"]).test.labels.tolist() == [0]


@pytest.fixture
def part_text(tmp_path):
    rng = np.random.default_rng(0)
    (tmp_path / "synsetoffset2category.txt").write_text(CATEGORIES)
    (tmp_path / "train_test_split").mkdir()
    for split, number in (("train", 3), ("val", 1), ("test", 2)):
        entries = []
        for synset in (PLANE, CHAIR):
            (tmp_path / synset).mkdir(exist_ok=True)
            for i in range(number):
                table = rng.normal(size=(20 + 10 * i, 7))
                np.savetxt(tmp_path / synset / f"{split}{i}.txt", table, fmt="%.6f")
                entries.append(f"shape_data/{synset}/{split}{i}")
        listing = tmp_path / "train_test_split" / f"shuffled_{split}_file_list.json"
        listing.write_text(json.dumps(entries))
    return tmp_path


def test_shapenet_part_text_draws_points(part_text):
    data = shapenet_part(part_text, n_points=25, normalize=False)
    assert data.class_names == ("Airplane", "Chair")
    assert data.train.points.shape == (8, 25, 3)
    assert data.test.labels.tolist() == [0, 0, 1, 1]
    for cloud, name in zip(data.test.points, ("test0", "test1"), strict=False):
        stored = np.loadtxt(part_text / PLANE / f"{name}.txt")[:, :3].astype(np.float32)
        rows = {tuple(row) for row in stored.tolist()}
        drawn = [tuple(row) for row in cloud.tolist()]
        assert set(drawn) <= rows
        assert len(set(drawn)) == min(25, len(stored))
    assert shapenet_part(part_text, n_points=25, normalize=False).fingerprint == data.fingerprint
    assert shapenet_part(part_text, 25, ["Chair"]).train.labels.tolist() == [0] * 4


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: (f / CHAIR / "test0.txt").write_text("a b"), "cannot be read as a table"),
        (lambda f: (f / CHAIR / "test0.txt").unlink(), "cannot be read as a table"),
        (lambda f: (f / CHAIR / "test0.txt").write_text("nan 1 2"), "must contain finite points"),
        (lambda f: (f / "synsetoffset2category.txt").write_text("x"), "a name and a synset"),
        (lambda f: (f / "synsetoffset2category.txt").unlink(), "no ShapeNetPart in"),
        (
            lambda f: (f / "train_test_split" / "shuffled_val_file_list.json").write_text("[1]"),
            "shuffled_val_file_list.json must be a list of names",
        ),
    ],
)
def test_shapenet_part_damaged_text_raises(part_text, damage, message):
    damage(part_text)
    with pytest.raises(UserError, match=message):
        shapenet_part(part_text, 8)


def test_shapenet_invalid_input_raises(core, part_hdf5, tmp_path):
    with pytest.raises(UserError, match=r"^n_points must be at most 60, .*\.ply, got 61"):
        shapenet_core(core, n_points=61)
    with pytest.raises(UserError, match=r"unknown class '0269115'.*02691156"):
        shapenet_core(core, classes=["0269115"])
    with pytest.raises(UserError, match=r"^test_share must be between 0 and 1, got 1"):
        shapenet_core(core, test_share=1)
    with pytest.raises(UserError, match=r"^n_points must be at least 1, got 0"):
        shapenet_core(core, n_points=0)
    (core / PLANE / "bad.ply").write_bytes(b"ply\nformat")
    with pytest.raises(UserError, match=r"bad.ply cannot be read as a PLY cloud"):
        shapenet_core(core, n_points=8)
    with pytest.raises(UserError, match=r"^root: .* is not a folder"):
        shapenet_part(tmp_path / "nowhere")
    for path in part_hdf5.glob("ply_data_test*"):
        path.unlink()
    with pytest.raises(UserError, match=r"no ply_data_test\*.h5 in"):
        shapenet_part(part_hdf5, 8)
