"""NumPy files."""

from typing import Any

import laspy
import numpy as np
import pytest

from mops_lightning.data.formats.registry import open_cloud_file, write
from mops_lightning.data.formats.table import Table
from mops_lightning.errors import UserError
from tests.support.cloud_files import contents, write_table


def first_rows(path):
    """Read the beginning of a file, as ``--chunk`` does."""
    return open_cloud_file(path).read(range(9))


READERS = pytest.mark.parametrize("reader", [first_rows, contents], ids=["True", "False"])


@READERS
@pytest.mark.parametrize("shape", [(20, 10), ()])
def test_npy_fields_of_wrong_shape_are_rejected(shape, reader, tmp_path):
    path = tmp_path / "a.npy"
    fields = [("x", "f4"), ("y", "f4"), ("z", "f4")]
    np.save(path, np.zeros(shape, fields))

    with pytest.raises(UserError, match="one row of fields"):
        reader(path)


@READERS
def test_npy_complex_coordinates_are_rejected(reader, tmp_path):
    path = tmp_path / "a.npy"
    fields = [("x", "f4"), ("y", "c8"), ("z", "f4")]
    np.save(path, np.zeros(20, fields))

    with pytest.raises(UserError, match="y must be numbers, got complex64"):
        reader(path)


def test_npy_fortran_order_is_rejected_in_chunks(tmp_path):
    path = tmp_path / "a.npy"
    by_column = np.asfortranarray(np.ones((90, 3)))
    np.save(path, by_column)

    with pytest.raises(UserError, match="C order"):
        open_cloud_file(path)


@pytest.mark.parametrize("kind", ["las", "laz", "copc.laz"])
def test_npz_arrays_become_dimensions_of_las_and_arrays_again(kind, tmp_path):
    source = tmp_path / "in.npz"
    path = tmp_path / f"cloud.{kind}"
    target = tmp_path / "back.npz"
    rng = np.random.default_rng(0)
    scores = rng.random((20, 4), np.float32)
    number = np.arange(20)
    named_alike: dict[str, Any] = {
        "normals": rng.random((20, 3), np.float32),
        "uv": rng.random((20, 2)),
        "rgb": rng.integers(0, 256, (20, 3), np.uint8),
        "classification": np.uint8(number % 6),
        "intensity": np.uint16(number * 3000),
    }
    points = np.arange(60.0).reshape(20, 3)
    np.savez(source, points=points, **named_alike, scores=scores)

    write_table(path, contents(source))
    write_table(target, contents(path))

    las = laspy.read(path)
    back = np.load(target)
    order = np.argsort(np.asarray(las.x))  # COPC sorts the points
    extra = list(las.point_format.extra_dimension_names)
    scores_apart = ["scores_0", "scores_1", "scores_2", "scores_3"]
    assert extra == ["normals", "uv", "rgb", *scores_apart]
    for name, values in named_alike.items():
        in_las = np.asarray(las[name])
        in_npz = back[name]
        assert np.array_equal(in_las[order], values)
        assert np.array_equal(in_npz[order], values)
        assert in_npz.dtype == values.dtype
    joined_scores = np.column_stack([back[name] for name in scores_apart])
    assert np.array_equal(joined_scores[order], scores)


@pytest.mark.parametrize(("largest", "version"), [(31, "1.2"), (200, "1.4")])
def test_classes_of_npz_decide_the_version_of_las(largest, version, tmp_path):
    source = tmp_path / "in.npz"
    target = tmp_path / "out.las"
    classes = np.array([1, 2, largest], np.uint8)
    np.savez(source, points=np.eye(3), classification=classes)

    write_table(target, contents(source))

    las = laspy.read(target)
    assert str(las.header.version) == version
    assert list(las.classification) == [1, 2, largest]
    assert not list(las.point_format.extra_dimension_names)


def test_npz_points_are_those_of_the_first_known_name(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, pos=np.ones((3, 3)), points=np.eye(3), xyz=np.zeros((3, 3)))

    table = contents(path)

    assert table.points.tolist() == np.eye(3).tolist()
    assert list(table.columns) == ["pos_0", "pos_1", "pos_2", "xyz_0", "xyz_1", "xyz_2"]


def test_npz_arrays_keep_their_shapes_and_come_in_native_order(tmp_path):
    source = tmp_path / "a.npz"
    out = tmp_path / "b.npz"
    one_wide = np.arange(3.0).reshape(3, 1)
    swapped = np.array([1, 2, 300], ">u2")
    np.savez(source, points=np.eye(3), score=one_wide, stamp=swapped)

    table = contents(source)
    write_table(out, table)

    assert table.columns["score"].tolist() == [0, 1, 2]
    assert table.columns["stamp"].dtype.isnative
    again = np.load(out)
    assert again["score"].tolist() == one_wide.tolist()
    assert again["stamp"].tolist() == [1, 2, 300]


def test_npz_array_of_which_a_column_changed_its_type_is_written_by_columns(tmp_path):
    source = tmp_path / "a.npz"
    out = tmp_path / "b.npz"
    rgb = np.arange(9, dtype=np.uint8).reshape(3, 3)
    np.savez(source, points=np.eye(3), rgb=rgb)
    fractions = np.array([0.5, 1.5, 2.5])

    write_table(out, contents(source).with_columns({"rgb_1": fractions}))

    again = np.load(out)
    assert set(again) == {"points", "rgb_0", "rgb_1", "rgb_2"}
    assert again["rgb_0"].dtype == np.uint8
    assert again["rgb_1"].tolist() == [0.5, 1.5, 2.5]


def test_npy_fields_in_another_byte_order_come_in_native_order(tmp_path):
    path = tmp_path / "a.npy"
    fields = [("x", ">f8"), ("y", ">f8"), ("z", ">f8"), ("label", ">i4")]
    rows = np.array([(1.5, 2.5, 3.5, 70_000)], fields)
    np.save(path, rows)

    table = contents(path)

    assert table.points.tolist() == [[1.5, 2.5, 3.5]]
    assert table.columns["label"].tolist() == [70_000]
    assert table.columns["label"].dtype.isnative


@pytest.mark.parametrize("name", ["points", "xyz", "pos", "positions", "the_only_one"])
def test_npz_points_have_one_of_four_names_or_any_if_alone(name, tmp_path):
    path = tmp_path / "a.npz"
    arrays: dict[str, Any] = {name: np.eye(3)}
    if name != "the_only_one":
        arrays["score"] = np.arange(3.0)
    np.savez(path, **arrays)

    table = contents(path)

    assert table.points.tolist() == np.eye(3).tolist()
    assert list(table.columns) == [other for other in arrays if other != name]


def test_npz_column_named_as_the_points_is_kept_beside_them(tmp_path):
    path = tmp_path / "a.npz"

    write_table(path, Table(np.eye(3), {"points": np.arange(3)}))

    arrays = np.load(path)
    assert arrays["points"].tolist() == np.eye(3).tolist()
    assert arrays["points_"].tolist() == [0, 1, 2]


def test_npz_fields_and_arrays_that_are_no_numbers_are_named(tmp_path):
    path = tmp_path / "a.npz"
    fields = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("name", "U3")]
    np.savez(path, points=np.zeros(3, fields), pose=np.eye(4))

    assert contents(path).form.left_out == ("name", "pose")


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (["column_3"], ""),
        (["column_3", "red"], "its columns are x, y, z, column_3, red, without names in the file"),
    ],
)
def test_npy_says_which_names_it_does_not_hold(names, said, tmp_path, capsys):
    columns = {name: np.zeros(3) for name in names}

    write(tmp_path / "a.npy", Table(np.eye(3), columns))

    out = capsys.readouterr().out
    assert said in out
    assert bool(out) == bool(said)


def test_what_a_format_lacks_is_said_beside_what_the_source_lost(tmp_path, capsys):
    source = tmp_path / "a.npz"
    np.savez(source, points=np.eye(3), score=np.zeros(3), names=["a", "b", "c"])

    write(tmp_path / "a.bin", contents(source))

    out = capsys.readouterr().out
    assert out.endswith("a.bin: no room for score: .bin holds x, y, z, intensity; without names\n")
