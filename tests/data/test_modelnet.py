import hashlib
import shutil
import threading
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from numpy.testing import assert_array_equal

from mops_lightning.data import modelnet
from mops_lightning.data.modelnet import FOLDER, modelnet40
from mops_lightning.errors import UserError
from tests.support.hdf5 import write_file
from tests.support.served import served

NAMES = ("airplane", "night_stand", "chair")  # not in alphabetical order
FILES = {"train": (0, 1, 2, 10), "test": (0, 1)}
STORED = 12


def cloud(split, file, row):
    """Return points that identify where they are stored."""
    random = np.random.default_rng([len(split), file, row])
    points = random.uniform(-1, 1, (STORED, 3))
    return points.astype(np.float32)


@pytest.fixture
def layout(tmp_path):
    """Write the public layout with 5 shapes per file and labels 0, 1, 2, 0, 1."""
    folder = tmp_path / "data" / FOLDER
    folder.mkdir(parents=True)
    names = "\n".join(NAMES)
    (folder / "shape_names.txt").write_text(f"{names}\n\n")
    label = np.array([[0], [1], [2], [0], [1]], dtype=np.uint8)
    for split, numbers in FILES.items():
        lines = []
        for number in numbers:
            name = f"ply_data_{split}{number}.h5"
            clouds = [cloud(split, number, row) for row in range(5)]
            write_file(folder / name, data=np.stack(clouds), label=label)
            lines.append(f"data/{FOLDER}/{name}")
        listed = "\r\n".join(lines)
        (folder / f"{split}_files.txt").write_text(listed)
    return folder


@pytest.mark.parametrize("split", ["train", "test"])
def test_modelnet_reads_all_shapes_in_order(split, layout):
    dataset = modelnet40(layout, n_points=STORED)

    clouds = getattr(dataset, split)
    expected = []
    for number in FILES[split]:
        for row in range(5):
            expected.append(cloud(split, number, row))
    assert dataset.class_names == NAMES
    assert_array_equal(clouds.points.numpy(), np.stack(expected))
    assert clouds.labels.tolist() == [0, 1, 2, 0, 1] * len(FILES[split])
    assert clouds.points.dtype == torch.float32
    assert clouds.labels.dtype == torch.int64
    assert clouds.points.is_contiguous()


def test_modelnet_fingerprint_depends_on_content(layout, tmp_path):
    def fingerprint(folder, n_points=4, classes=None):
        return modelnet40(folder, n_points, classes).fingerprint

    elsewhere = shutil.copytree(layout, tmp_path / "elsewhere")
    first = fingerprint(layout)
    of_copy = fingerprint(elsewhere)
    more_points = fingerprint(layout, n_points=5)
    first_classes = fingerprint(layout, classes=NAMES[:2])
    last_classes = fingerprint(layout, classes=NAMES[1:])
    with h5py.File(elsewhere / "ply_data_test0.h5", "r+") as file:
        file["data"][3, 2, 1] += 1
    other_point = fingerprint(elsewhere)
    with h5py.File(elsewhere / "ply_data_train0.h5", "r+") as file:
        file["label"][0] = 1
    other_label = fingerprint(elsewhere)

    assert of_copy == first
    different = {first, more_points, first_classes, last_classes, other_point, other_label}
    assert len(different) == 6


def test_modelnet_lists_written_on_windows_name_the_same_files(layout):
    dataset = modelnet40(layout, n_points=4)
    for path in layout.glob("*_files.txt"):
        listed = path.read_text().replace("/", "\\")
        path.write_text(listed)

    again = modelnet40(layout, n_points=4)

    assert again.fingerprint == dataset.fingerprint


def test_modelnet_archive_is_the_published_one():
    assert modelnet.ARCHIVE_HASH == "md5:c9ab8e6dfb16f67afdab25e155c79e59"
    assert modelnet.MIRRORS == (
        "https://huggingface.co/datasets/Msun/modelnet40/resolve/main/modelnet40_ply_hdf5_2048.zip",
        "https://shapenet.cs.stanford.edu/media/modelnet40_ply_hdf5_2048.zip",
    )


def test_modelnet_missing_folder_raises(tmp_path):
    missing = tmp_path / "none"

    with pytest.raises(UserError) as caught:
        modelnet40(missing)

    said = str(caught.value)
    for words in ("root: ", str(missing), "shape_names.txt", "dataset.download=true"):
        assert words in said


def test_modelnet_missing_lists_raise(layout):
    for path in layout.glob("*test*"):
        path.unlink()
    with pytest.raises(UserError, match=r"test_files\.txt: no such file"):
        modelnet40(layout, n_points=4)
    (layout / "shape_names.txt").unlink()
    with pytest.raises(UserError, match=r"shape_names\.txt: no such file"):
        modelnet40(layout, n_points=4)


def test_modelnet_class_without_shapes_raises(layout):
    cloud = np.zeros((1, STORED, 3))
    label = np.zeros(1, np.uint8)
    for number in FILES["test"]:
        path = layout / f"ply_data_test{number}.h5"
        write_file(path, data=cloud, label=label)

    with pytest.raises(UserError, match=r"^classes: .* has no test shape of chair"):
        modelnet40(layout, n_points=4, classes=["chair"])


@pytest.fixture
def mirror(layout, tmp_path, monkeypatch):
    """The archive on the second of two mirrors, with the expected hash; what is requested."""
    shelf = str(tmp_path / "shelf" / "set")
    archive = Path(shutil.make_archive(shelf, "zip", layout.parent, FOLDER))
    content = archive.read_bytes()
    digest = hashlib.md5(content).hexdigest()
    monkeypatch.setattr(modelnet, "ARCHIVE_HASH", f"md5:{digest}")
    with served(archive.parent) as (address, requested):
        mirrors = (f"{address}/gone.zip", f"{address}/set.zip")
        monkeypatch.setattr(modelnet, "MIRRORS", mirrors)
        yield requested


@pytest.mark.parametrize("name", ["data", f"data/{FOLDER}"])
def test_modelnet_downloads_once(layout, mirror, tmp_path, name):
    root = tmp_path / "new" / name
    found: list[str] = []

    def load() -> None:
        dataset = modelnet40(root, n_points=4, download=True)
        found.append(dataset.fingerprint)

    threads = [threading.Thread(target=load) for _ in range(3)]  # as a sweep would start them
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    load()

    expected = modelnet40(layout, n_points=4).fingerprint
    left_over = list((tmp_path / "new").rglob("*.zip*"))
    assert found == [expected] * 4
    assert mirror == ["/gone.zip", "/set.zip"]
    assert not left_over


def test_modelnet_wrong_hash_or_unwritable_root_raises(mirror, tmp_path, monkeypatch):
    zeros = "0" * 32
    monkeypatch.setattr(modelnet, "ARCHIVE_HASH", f"md5:{zeros}")
    new = tmp_path / "new"
    file = tmp_path / "file"
    file.touch()

    with pytest.raises(UserError, match=r"gone\.zip: .*404.*set\.zip: .*hash.*save the file as"):
        modelnet40(new, download=True)
    with pytest.raises(UserError, match=r"Cannot download ModelNet40 into"):
        modelnet40(file / "data", download=True)

    left_over = list(new.rglob("*.zip"))
    assert not left_over


def test_modelnet_in_the_folder_above_is_the_same(layout):
    dataset = modelnet40(layout, n_points=STORED)

    by_parent = modelnet40(str(layout.parent), n_points=STORED)

    assert by_parent.fingerprint == dataset.fingerprint


def test_modelnet_real_data(real_data):
    root = real_data("modelnet40_hdf5_1024")

    dataset = modelnet40(root)

    train = dataset.train
    test = dataset.test
    assert train.points.shape == (9843, 1024, 3)
    assert test.points.shape == (2468, 1024, 3)
    assert len(dataset.class_names) == 40
    assert train.labels.unique().tolist() == list(range(40))
    airplane = dataset.class_names.index("airplane")
    assert (train.labels == airplane).sum() == 626
    assert (test.labels == airplane).sum() == 100
    radius = test.points.norm(dim=2).amax(1)
    assert radius.min() > 0.9
    assert radius.max() < 1.001
