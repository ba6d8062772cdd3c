import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch

from mops_lightning.data.hdf5 import hdf5, read_clouds
from mops_lightning.errors import UserError
from tests.support.hdf5 import write_file


@pytest.fixture
def folder(tmp_path):
    rng = np.random.default_rng(0)
    for split, number in (("train", 6), ("test", 4)):
        points = rng.normal(size=(number, 50, 3))
        labels = np.arange(number) % 2
        names = np.array([b"x"] * number)
        with h5py.File(tmp_path / f"{split}.h5", "w") as file:
            file["data"] = points.astype(np.float32)
            file["label"] = labels.astype(np.uint8)  # ModelNet40's are (S, 1)
            file["name"] = names
    return tmp_path


def test_hdf5_reads_first_points(folder):
    data = hdf5(folder, n_points=20)
    again = hdf5(folder, n_points=20)
    other = hdf5(folder, n_points=21)

    whole = hdf5(folder, n_points=50)
    with h5py.File(folder / "test.h5") as file:
        stored = torch.from_numpy(file["data"][:])
    assert torch.equal(whole.test.points, stored)
    assert data.class_names == ("class_0", "class_1")
    assert data.train.points.shape == (6, 20, 3)
    assert torch.equal(data.test.points, stored[:, :20])
    assert data.fingerprint == again.fingerprint
    assert data.fingerprint != other.fingerprint


def test_hdf5_class_names_and_selection(folder):
    names = folder / "shape_names.txt"
    names.write_text("airplane\n\n  bowl \n")

    data = hdf5(folder, 20, ["bowl"])

    assert data.class_names == ("bowl",)
    assert data.test.labels.tolist() == [0, 0]
    names.write_text("airplane\n")
    with pytest.raises(UserError, match=r"labels from 0 to 0, .* lists 1 classes, got 0 to 1"):
        hdf5(folder, 20)


@pytest.mark.parametrize("names", ["airplane\nbowl\nairplane\n", "\n"], ids=["twice", "empty"])
def test_hdf5_names_that_are_not_each_class_once_are_refused(names, folder):
    (folder / "shape_names.txt").write_text(names)

    with pytest.raises(UserError, match=r"shape_names\.txt must list each class once"):
        hdf5(folder, 20)


@pytest.mark.parametrize(
    ("train", "test"),
    [
        ([0, 2], [1, 0]),
        ([1, 0], [0, 2]),
    ],
)
def test_hdf5_without_names_has_the_classes_of_both_splits(tmp_path, train, test):
    points = np.zeros((2, 5, 3), np.float32)
    write_file(tmp_path / "train.h5", data=points, label=np.array(train))
    write_file(tmp_path / "test.h5", data=points, label=np.array(test))

    data = hdf5(tmp_path, n_points=5)

    assert data.class_names == ("class_0", "class_1", "class_2")
    assert data.train.labels.tolist() == train
    assert data.test.labels.tolist() == test


def test_hdf5_invalid_input_raises(folder, tmp_path):
    with pytest.raises(UserError, match=r"^n_points must be at least 1, got 0"):
        hdf5(folder, 0)
    with pytest.raises(UserError, match=r"^root: .*/nowhere/train.h5 is missing"):
        hdf5(tmp_path / "nowhere")
    with pytest.raises(UserError, match=r"^n_points must be at most 50, .*h5, got 51"):
        hdf5(folder, 51)
    (folder / "test.h5").unlink()
    with pytest.raises(UserError, match=r"^root: .*test.h5 is missing"):
        hdf5(folder, 20)


def of_shapes(number, **options):
    """Arguments of datasets that announce a number of shapes."""
    points = {"shape": (number, 50, 3), "dtype": "f4", **options}
    return {"data": points, "label": {"shape": (number,), "dtype": "u1", **options}}


EXTERNAL = of_shapes(6, external="/etc/passwd")


def of_labels(value):
    """Arguments of a dataset of six equal labels."""
    return {"label": {"data": np.full(6, value)}}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (of_labels(2_000_000_000), "labels from 0 to 9999, without shape_"),
        (of_labels(10_000), "labels from 0 to 9999, without shape_.* got 10000 to 10000"),
        (of_labels(-1), "labels from 0 to 9999, .* got -1 to -1"),
        (of_shapes(0), "no shapes"),
        (of_shapes(10**9, chunks=True), "announces 1,000,000,000 shapes"),
        ({"data": EXTERNAL["data"]}, "'data' refers to other files"),
    ],
    ids=["huge label", "label above the limit", "negative label", "empty", "too many", "external"],
)
def test_hdf5_crafted_file_raises(changes, message, folder):
    with h5py.File(folder / "train.h5", "a") as file:
        for key, options in changes.items():
            del file[key]
            file.create_dataset(key, **options)
    with pytest.raises(UserError, match=message):
        hdf5(folder, 20)


@pytest.mark.parametrize("link", ["external", "soft", "virtual"])
def test_hdf5_data_of_another_file_raises(link, folder):
    with h5py.File(folder / "train.h5", "a") as file:
        del file["data"]
        if link == "virtual":
            layout = h5py.VirtualLayout((6, 50, 3), "f4")
            layout[:4] = h5py.VirtualSource(str(folder / "test.h5"), "data", (4, 50, 3))
            file.create_virtual_dataset("data", layout)
        else:
            other = h5py.ExternalLink(str(folder / "test.h5"), "/data")
            file["other"] = other
            links = {"external": other, "soft": h5py.SoftLink("/other")}
            file["data"] = links[link]

    with pytest.raises(UserError, match="'data' refers to other files"):
        hdf5(folder, 20)


def test_hdf5_real_data(real_data):
    root = real_data("modelnet40_airplane_10000")

    data = hdf5(root, n_points=10_000)

    radii = data.test.points.norm(dim=2)
    assert data.train.points.shape == (626, 10_000, 3)
    assert data.test.points.shape == (100, 10_000, 3)
    assert radii.max() < 1.001


def set_item(path: Path, key: str, place: Any, value: float) -> None:
    with h5py.File(path, "r+") as file:
        file[key][place] = value


shaped = partial(np.zeros, dtype=np.float32)
label = np.zeros((2, 1), dtype=np.uint8)
CLOUDS = shaped((2, 12, 3))
FILES: dict[str, tuple[dict[str, Any], str]] = {
    "no data": ({"label": label}, r"no dataset 'data'; it contains \['label'\]"),
    "no label": ({"data": CLOUDS}, "no dataset 'label'"),
    "flat": ({"data": shaped((2, 36)), "label": label}, r"got \(2, 36\)"),
    "scalar": ({"data": 1.0, "label": label}, r"got \(\)"),
    "2-D": ({"data": shaped((2, 12, 2)), "label": label}, r"\(2, 12, 2\)"),
    "counts": ({"data": shaped((3, 12, 3)), "label": label}, r"and \(2, 1\)"),
    "two labels": ({"data": CLOUDS, "label": np.zeros((2, 2), np.uint8)}, r"and \(2, 2\)"),
    "integers": ({"data": np.ones((2, 12, 3), int), "label": label}, "int64"),
    "words": ({"data": CLOUDS, "label": [b"a", b"b"]}, "of integers"),
    "overflow": ({"data": np.full((2, 12, 3), 1e300), "label": label}, "NaN or infinite"),
}
"""What a file contains, and what its error says."""

DAMAGES: dict[str, tuple[Callable[[Path], Any], str]] = {
    "cut off": (lambda p: os.truncate(p, p.stat().st_size // 2), "is broken"),
    "empty": (lambda p: os.truncate(p, 0), "is broken"),
    "text": (lambda p: p.write_text("<html>Not found</html>"), "is broken"),
    "class 3": (
        lambda p: set_item(p, "label", 2, 3),
        "labels from 0 to 2, .* lists 3 classes, got 0 to 3",
    ),
    "NaN": (lambda p: set_item(p, "data", (1, 2, 0), np.nan), "NaN or infinite"),
    "missing": (lambda p: p.unlink(), "is missing"),
}
"""What happens to a good file, and what its error says."""


@pytest.mark.parametrize("kind", [*DAMAGES, *FILES])
def test_read_clouds_damaged_file_raises(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "train.h5"
    if kind in FILES:
        datasets, message = FILES[kind]
        write_file(path, **datasets)
    else:
        damage, message = DAMAGES[kind]
        write_file(path, data=shaped((3, 12, 3)), label=np.zeros((3, 1), np.uint8))
        damage(path)

    with pytest.raises(UserError, match=rf"(?s)train\.h5.*{message}"):
        read_clouds(path, 4, 3)


def test_read_clouds_corrupted_file_raises(tmp_path: Path) -> None:
    path = tmp_path / "train.h5"
    data = np.random.default_rng(0).random((50, 12, 3))
    labels = np.zeros(50, dtype=np.uint8)
    with h5py.File(path, "w") as file:
        file.create_dataset("data", data=data, compression="gzip", fletcher32=True)
        file.create_dataset("label", data=labels)
        first_chunk = file["data"].id.get_chunk_info(0)
    content = bytearray(path.read_bytes())
    content[first_chunk.byte_offset + 100] ^= 0xFF
    path.write_bytes(content)

    with pytest.raises(UserError, match=r"train\.h5 is broken"):
        read_clouds(path, 4, 3)
