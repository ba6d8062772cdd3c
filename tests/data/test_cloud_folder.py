import math
from collections import Counter
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from torch.testing import assert_close
from trimesh.creation import box

from mops_lightning.data import cloud_folder as module
from mops_lightning.errors import UserError
from tests.support.cloud_files import write_cloud
from tests.support.clouds import normal_points, uniform_points
from tests.support.meshes import write_mesh

cloud_folder = partial(module.cloud_folder, test_frames=None, crop="nearest", crops=32)

FORMATS = (".ply", ".pcd", ".bin", ".npy", ".npz", ".xyz", ".txt")


def write(path, seed=0, number=300):
    path.parent.mkdir(parents=True, exist_ok=True)
    unit = normal_points(number, seed)
    points = unit * [3, 2, 1] + 50
    write_cloud(path, points)


@pytest.fixture
def folder(tmp_path):
    """One cloud per format, and a mesh."""
    for seed, suffix in enumerate(FORMATS):
        write(tmp_path / f"scan_{seed}{suffix}", seed)
    write_mesh(tmp_path / "box.stl", box())
    return tmp_path


def all_clouds(data):
    """Return the clouds of both splits."""
    return torch.cat([data.train.points, data.test.points])


def test_cloud_folder_reads_every_format_without_labels_and_each_file_for_one_split(folder):
    data = cloud_folder(folder, n_points=64, crops=3)

    train = data.train.points
    assert data.class_names == ("cloud",)
    assert train.shape == (18, 64, 3)
    assert data.test.points.shape == (6, 64, 3)
    assert data.notes["train_files"] == 6
    assert data.notes["test_files"] == 2
    assert torch.isfinite(train).all()
    farthest = train.norm(dim=2).amax(1)
    assert farthest.allclose(torch.ones(18))
    assert train.mean(1).abs().max() < 1e-5
    assert data.train.sources is not None
    assert data.test.sources is not None
    train_files = data.train.sources.tolist()
    test_files = data.test.sources.tolist()
    assert set(Counter(train_files).values()) == {3}
    assert set(train_files).isdisjoint(test_files)


@pytest.mark.parametrize(
    ("crop", "expected"),
    [
        ("whole", 1),
        ("nearest", 32),
    ],
)
def test_cloud_folder_without_number_of_crops_draws_whole_clouds_once(tmp_path, crop, expected):
    for seed in range(4):
        write(tmp_path / f"scan_{seed}.ply", seed)

    data = cloud_folder(tmp_path, n_points=64, crop=crop, crops=None)

    assert len(data.train.points) == 3 * expected
    assert len(data.test.points) == expected


def test_cloud_folder_crops_do_not_depend_on_other_files(folder):
    everything = cloud_folder(folder, n_points=64, crops=2, crop="whole")
    (folder / "scan_3.npy").unlink()

    fewer = cloud_folder(folder, n_points=64, crops=2, crop="whole")

    clouds = all_clouds(everything)
    for cloud in all_clouds(fewer):
        is_same = (clouds == cloud).all(2).all(1)
        assert is_same.any()
    assert fewer.fingerprint != everything.fingerprint


def test_cloud_folder_columns_name_those_of_bin_files(tmp_path):
    xyz = normal_points(300, 0).astype(np.float32)
    constant_first = np.insert(xyz, 0, 7.0, axis=1)
    folder = tmp_path / "points"
    folder.mkdir()
    in_float64 = xyz.astype(np.float64)
    for name in ("a", "b"):
        constant_first.tofile(folder / f"{name}_named.bin")
        write_cloud(folder / f"{name}.ply", in_float64)

    data = cloud_folder(
        tmp_path,
        n_points=300,
        crops=1,
        crop="whole",
        test_share=0.5,
        columns=["intensity", "x", "y", "z"],
    )

    centred = xyz - xyz.mean(0)
    expected = centred / np.linalg.norm(centred, axis=1).max()
    expected.sort(axis=0)
    for cloud in all_clouds(data).numpy():
        cloud.sort(axis=0)
        assert_allclose(cloud, expected, atol=1e-5)


def test_cloud_folder_folders_are_classes_and_splits(tmp_path):
    write(tmp_path / "tree" / "train" / "a.ply", 0)
    write(tmp_path / "tree" / "test" / "b.ply", 1)
    write(tmp_path / "car" / "train" / "c.ply", 2)
    write(tmp_path / "car" / "test" / "d.ply", 3)

    data = cloud_folder(tmp_path, n_points=32, crops=2)
    cars = cloud_folder(tmp_path, n_points=32, classes=["car"])

    assert data.class_names == ("car", "tree")
    assert data.train.labels.tolist() == [0, 0, 1, 1]
    assert data.test.labels.tolist() == [0, 0, 1, 1]
    assert cars.class_names == ("car",)


def test_cloud_folder_broken_file_is_named(folder):
    notes = folder / "notes.txt"
    notes.write_text("scanned on Monday\n")

    with pytest.raises(UserError, match=r"notes\.txt"):
        cloud_folder(folder, n_points=64)
    notes.unlink()
    write(folder / "small.ply", number=10)
    with pytest.raises(UserError, match=r"small\.ply has 10 points, fewer .*or remove the file"):
        cloud_folder(folder, n_points=64)


@pytest.mark.parametrize(
    ("file", "split", "consequence"),
    [
        ("ball/test/ball_3.OFF", "test", "never scored"),
        ("ball/train/ball_1.off", "train", "never learned"),
    ],
)
def test_cloud_folder_class_in_one_split_is_reported(file, split, consequence, mesh_layout, capsys):
    (mesh_layout / file).unlink()

    data = cloud_folder(mesh_layout, n_points=20, crop="surface", crops=1)

    assert data.notes[f"classes_without_{split}_files"] == ["ball"]
    assert f"no {split} file of ball: {consequence}" in capsys.readouterr().err


def test_cloud_folder_without_a_test_file_is_refused(tmp_path):
    write(tmp_path / "alone.ply")

    with pytest.raises(UserError, match="has no test file of cloud: give at least two files"):
        cloud_folder(tmp_path, n_points=64)


def test_cloud_folder_leaves_out_points_that_are_not_finite(tmp_path):
    points = normal_points(100, 0)
    points[::2] = np.nan
    rows = np.arange(100)
    for name in ("a", "b"):
        write_cloud(tmp_path / f"{name}.ply", points, {"row": rows})

    data = cloud_folder(tmp_path, n_points=50, crop="whole", crops=1, label="row")

    assert torch.isfinite(all_clouds(data)).all()
    assert data.train.parts is not None
    odd_rows = tuple(str(row) for row in range(1, 100, 2))
    assert data.part_names == odd_rows
    found = data.train.parts.sort().values
    assert found.tolist() == [list(range(50))]


def test_cloud_folder_crops_depend_on_the_seed_and_on_the_file(tmp_path):
    """Both files hold the same points and are in folders of the splits."""
    for split in ("train", "test"):
        write(tmp_path / split / f"{split}.ply")
    settings: dict[str, Any] = {"n_points": 50, "crop": "whole", "crops": 1}

    data = cloud_folder(tmp_path, **settings)
    other = cloud_folder(tmp_path, **settings, seed=1)

    assert not torch.equal(data.train.points, data.test.points)
    assert not torch.equal(data.train.points, other.train.points)
    assert not torch.equal(data.test.points, other.test.points)


def test_cloud_folder_folders_of_splits_come_before_the_share(tmp_path):
    for number in range(4):
        write(tmp_path / "train" / f"{number}.ply", number)
    write(tmp_path / "test" / "single.ply", 9)

    data = cloud_folder(tmp_path, n_points=20, crops=1, test_share=0.5)

    assert data.notes == {"train_files": 4, "test_files": 1}


def test_cloud_folder_part_zero_is_known_and_negative_numbers_are_not(tmp_path):
    points = normal_points(40, 0)
    numbers = np.repeat([-3, 0, 4, 9], 10)
    for name in ("a", "b"):
        write_cloud(tmp_path / f"{name}.ply", points, {"kind": numbers})

    data = cloud_folder(tmp_path, n_points=40, crop="nearest", crops=1, label="kind")

    assert data.part_names == ("0", "4", "9")
    for clouds in (data.train, data.test):
        assert clouds.parts is not None
        expected = np.repeat([-1, 0, 1, 2], 10)
        assert clouds.parts.tolist() == [expected.tolist()]


def test_cloud_folder_part_numbers_belong_to_the_drawn_points(tmp_path):
    points = normal_points(90, 0)
    side = (points[:, 0] > 0).astype(int)
    for name in ("a", "b"):
        write_cloud(tmp_path / f"{name}.ply", points, {"side": side})

    data = cloud_folder(tmp_path, n_points=40, crop="whole", crops=1, label="side")

    for clouds in (data.train, data.test):
        assert clouds.parts is not None
        is_right = clouds.parts[0] == 1
        x = clouds.points[0, :, 0]
        assert x[is_right].min() > x[~is_right].max()


@pytest.mark.parametrize(
    ("n_points", "length"),
    [
        (500, 2),  # a twentieth of 10,000 points
        (2000, 5),  # an eighth of 16,000 points
    ],
)
def test_cloud_folder_crop_of_a_mesh_is_at_most_an_eighth_of_its_surface(
    n_points, length, tmp_path
):
    plate = box((40, 1, 0.001))
    for name in ("a", "b"):
        write_mesh(tmp_path / f"{name}.stl", plate)

    data = cloud_folder(tmp_path, n_points=n_points, crops=1)

    for cloud in all_clouds(data).numpy():
        extent = np.ptp(cloud, axis=0)
        assert extent[0] / extent[1] == pytest.approx(length, rel=0.15)


def test_cloud_folder_surface_reads_modelnet_layout(mesh_layout, capsys):
    data = cloud_folder(mesh_layout, n_points=200, crop="surface", crops=1)

    assert data.class_names == ("ball", "box")
    assert data.train.labels.tolist() == [0, 1, 1]
    assert data.test.labels.tolist() == [0, 1]
    assert data.notes == {"train_files": 3, "test_files": 2}
    for clouds in (data.train, data.test):
        number = len(clouds.labels)
        assert clouds.points.shape == (number, 200, 3)
        assert clouds.points.dtype == torch.float32
        assert clouds.labels.dtype == torch.int64
        means = clouds.points.mean(1)
        assert_close(means, torch.zeros(number, 3))
        farthest = clouds.points.norm(dim=2).amax(1)
        assert_close(farthest, torch.ones(number))
    assert capsys.readouterr() == ("", "")  # no progress bar without a terminal


def test_cloud_folder_splits_every_class_by_share(tmp_path):
    """ShapeNetCore's layout: SYNSET/*.ply, objects that overlap each other."""
    numbers = {"02691156": 20, "03001627": 5, "alone": 1}
    for synset, number in numbers.items():
        for i in range(number):
            write(tmp_path / synset / f"{i:032x}.ply", seed=i, number=60)
    by_share = partial(cloud_folder, n_points=50, crop="whole", crops=1, test_share=0.15)

    data = by_share(tmp_path)
    again = by_share(tmp_path, seed=0)
    other = by_share(tmp_path, seed=1)

    assert data.class_names == ("02691156", "03001627", "alone")
    assert data.train.points.shape == (17 + 4 + 1, 50, 3)
    assert data.test.labels.tolist() == [0, 0, 0, 1]
    assert data.train.sources is None
    assert torch.equal(again.test.points, data.test.points)
    assert again.fingerprint == data.fingerprint
    assert other.fingerprint != data.fingerprint


def frames_of(clouds, label):
    """Return the frame numbers of a class, which are the lengths of the boxes less 1."""
    points = clouds.points[clouds.labels == label]
    size = points.amax(1) - points.amin(1)
    lengths = size[:, 2] / size[:, 0]
    frames = (lengths - 1).round().int()
    return sorted(frames.tolist())


def test_cloud_folder_splits_sequences_by_time(tmp_path):
    """Two sequences of boxes that grow with time; frame numbers are not padded."""
    for name, frames in (("crane", 12), ("samba", 10)):
        for frame in range(frames):
            path = tmp_path / name / f"mesh_{frame}.ply"
            write_mesh(path, box((1, 1, 1 + frame)))
        (tmp_path / name / "notes.txt").write_text("no mesh")

    data = cloud_folder(
        tmp_path,
        n_points=3000,
        crop="surface",
        crops=1,
        test_frames="last",
        test_share=0.25,
        gap=2,
    )

    assert data.class_names == ("crane", "samba")
    assert frames_of(data.test, 0) == [9, 10, 11]
    assert frames_of(data.test, 1) == [8, 9]
    assert frames_of(data.train, 0) == [0, 1, 2, 3, 4, 5, 6]
    assert frames_of(data.train, 1) == [0, 1, 2, 3, 4, 5]


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
        ({"test_share": 0.0}, "test_share must be between 0 and 1, got 0.0"),
        ({"test_frames": "lats"}, "test_frames must be last or null, got 'lats'"),
        ({"crops": 0}, "crops must be at least 1"),
        ({"n_points": 0}, "n_points must be at least 2, got 0"),
        ({"n_points": 1}, "n_points must be at least 2, got 1"),
        ({"gap": -1}, "gap must be at least 0, got -1"),
        ({"seed": -1}, "seed must be at least 0, got -1"),
        ({"columns": ["x", "y"]}, "columns must name all columns of a .bin file.*got 'x,y'"),
        ({"columns": "x,y,z"}, "columns must name all columns.*got 'x,y,z'"),
        ({"columns": list("xyz"), "crop": "surface", "crops": 1}, "columns must be null with"),
        ({"label": "part", "crop": "surface", "crops": 1}, "label must be null with"),
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


def test_cloud_folder_tiles_score_every_labelled_point_of_a_file_once(tmp_path):
    for seed, number in enumerate((300, 500, 700)):
        points = uniform_points(number, seed) * [40, 30, 2]
        classes = np.where(points[:, 2] < 1, 2, 5)
        write_cloud(tmp_path / f"{seed}.ply", points, {"classification": classes})

    data = cloud_folder(tmp_path, 128, crop="tiles", crops=None, label="classification")

    counts = []
    for clouds in (data.train, data.test):
        assert clouds.parts is not None
        assert clouds.sources is not None
        for source in clouds.sources.unique():
            parts = clouds.parts[clouds.sources == source]
            known = int((parts >= 0).sum())
            counts.append(known)
            assert len(parts) == math.ceil(known / 128)
    assert sorted(counts) == [300, 500, 700]
    assert data.part_names == ("2", "5")


def test_cloud_folder_number_of_tiles_is_refused(tmp_path):
    write(tmp_path / "scan.ply")

    with pytest.raises(UserError, match="crops must be null with crop=tiles"):
        cloud_folder(tmp_path, 64, crop="tiles", crops=3)
