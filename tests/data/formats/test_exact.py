"""Rows that are written are the rows that were read, to the bit."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mops_lightning.data.formats.registry import write
from mops_lightning.data.formats.table import Form, Table
from mops_lightning.errors import UserError
from tests.support.cloud_files import contents
from tests.support.clouds import uniform_points

NEAR_ORIGIN = uniform_points(20, 0)
"""Numbers that float32 would change by less than a millionth of the cloud."""

NANOSECONDS = np.arange(20) + 1_764_290_000_123_456_789


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".npy", ".npz", ".xyz"])
def test_write_double_coordinates_near_origin_keeps_every_bit(suffix, tmp_path):
    path = tmp_path / f"a{suffix}"
    float64 = Form(np.dtype(np.float64))

    write(path, Table(NEAR_ORIGIN, form=float64))

    again = contents(path)
    assert_array_equal(again.points, NEAR_ORIGIN)


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".npy", ".npz"])
def test_write_coordinates_of_float32_file_stay_float32(suffix, tmp_path):
    source = tmp_path / "in.npy"
    path = tmp_path / f"a{suffix}"
    single = NEAR_ORIGIN.astype(np.float32)
    np.save(source, single)

    write(path, contents(source))

    again = contents(path)
    assert again.form.coordinates == np.float32
    assert_array_equal(again.points, single)


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".txt", ".pcd", ".las"])
def test_write_integers_of_64_bits_keep_all_digits(suffix, tmp_path, capsys):
    path = tmp_path / f"a{suffix}"
    large = np.arange(20, dtype=np.uint64) + np.uint64(2**63 + 5)

    write(path, Table(NEAR_ORIGIN, {"stamp": NANOSECONDS, "id": large}))

    columns = contents(path).columns
    # As Python's integers: NumPy compares integers with floats as floats.
    assert columns["stamp"].tolist() == NANOSECONDS.tolist()
    assert columns["id"].tolist() == large.tolist()
    said_rows_of_fields = "rows of named fields" in capsys.readouterr().out
    assert said_rows_of_fields == (suffix == ".npy")


def test_write_integers_beyond_ply_are_refused_and_others_are_kept(tmp_path):
    path = tmp_path / "a.ply"
    exact_in_float64 = np.arange(20) + 2**50

    with pytest.raises(UserError, match=r"no type for 'stamp'.*Write \.npz or \.las"):
        write(path, Table(NEAR_ORIGIN, {"stamp": NANOSECONDS}))
    assert not path.exists()
    write(path, Table(NEAR_ORIGIN, {"id": exact_in_float64}))

    columns = contents(path).columns
    assert_array_equal(columns["id"], exact_in_float64)


def test_ascii_pcd_integers_of_64_bits_keep_all_digits(tmp_path):
    path = tmp_path / "a.pcd"
    head = "FIELDS x y z t\nSIZE 4 4 4 8\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 2\nPOINTS 2\n"
    path.write_text(f"{head}DATA ascii\n1 2 3 18446744073709551615\n4 5 6 1764290000123456789\n")

    stamps = contents(path).columns["t"]

    assert stamps.tolist() == [18446744073709551615, 1764290000123456789]


def test_float16_becomes_float32_in_pcd_and_ply(tmp_path):
    score = np.linspace(0, 1, 20).astype(np.float16)
    for suffix in (".pcd", ".ply"):
        path = tmp_path / f"a{suffix}"
        write(path, Table(NEAR_ORIGIN, {"score": score}))

        again = contents(path).columns["score"]

        assert again.dtype == np.float32
        assert_array_equal(again, score)


def test_bin_says_how_many_numbers_change_and_what_has_no_room(tmp_path, capsys):
    whole = np.array([0, 2**24 + 1, 2**24 + 2])
    columns = {"intensity": whole, "red": whole}

    write(tmp_path / "a.bin", Table(np.zeros((3, 3)), columns))

    said = capsys.readouterr().out
    assert "1 numbers of intensity are rounded to float32; no room for red" in said


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("# x y z\n1 2 3\n4 5 6\n", "# x y z label\n1 2 3 7\n4 5 6 8\n"),
        ("z,x,y\n3,1,2\n6,4,5\n", "z,x,y,label\n3,1,2,7\n6,4,5,8\n"),
        ("1 2 3\n4 5 6\n", "# x y z label\n1 2 3 7\n4 5 6 8\n"),
    ],
)
def test_text_with_a_new_column_has_it_last_in_rows_and_header(text, expected, tmp_path):
    source = tmp_path / "in.txt"
    out = tmp_path / "out.txt"
    source.write_text(text)
    table = contents(source)

    write(out, table.with_columns({"label": np.array([7, 8])}))

    assert out.read_text() == expected


@pytest.mark.parametrize(
    "text",
    [
        '"X","Y","Z","class","stamp"\n0.1,2.5,1e-07,3,1764290000123456789\n1,2.25,3.7,4,1\n',
        "//X;Y;Z;Scalar field\n0.1;2;3;4.5\n1.5;2.25;3;0.1\n",
        "# x y z\n0.1 0.2 0.30000000000000004\n1234567.125 0.5 1e+22\n",
        "0.1\t0.2\t0.3\n4\t5\t6.5\n",
        "easting northing height class\n1 2 3 4\n5 6 7 8\n",
        "2\n0.1 0.2 0.3\n0.4 0.5 0.6\n",
    ],
)
def test_text_is_written_as_it_was_read(text, tmp_path):
    source = tmp_path / "in.txt"
    out = tmp_path / "out.txt"
    source.write_text(text)

    write(out, contents(source))

    assert out.read_text() == text


def test_text_of_float32_has_the_fewest_digits_of_its_type(tmp_path):
    single = np.array([[0.1, 0.2, 1 / 3]], np.float32)
    source = tmp_path / "in.npy"
    out = tmp_path / "out.txt"
    np.save(source, single)

    write(out, contents(source))

    text = out.read_text()
    again = np.array(text.split(), np.float32)
    assert text == "0.1 0.2 0.33333334\n"
    assert_array_equal(again, single[0])


def test_pcd_keeps_fields_of_several_numbers_and_viewpoint(tmp_path):
    head = (
        "FIELDS x y z fpfh\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 2\nWIDTH 1\n"
        "VIEWPOINT 1 2 3 0 1 0 0\nPOINTS 1\n"
    )
    source = tmp_path / "in.pcd"
    out = tmp_path / "out.pcd"
    source.write_text(f"{head}DATA ascii\n1 2 3 4.5 5.5\n")

    write(out, contents(source))

    lines = out.read_bytes().split(b"\n")
    assert b"FIELDS x y z fpfh" in lines
    assert b"COUNT 1 1 1 2" in lines
    assert b"VIEWPOINT 1 2 3 0 1 0 0" in lines
    again = contents(out)
    assert list(again.columns) == ["fpfh_0", "fpfh_1"]


def test_coordinates_beyond_float64_are_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.full((3, 3), 2**60 + 1))

    with pytest.raises(UserError, match="x has numbers that float64 does not hold exactly"):
        contents(tmp_path / "a.npy")


def test_npz_keeps_arrays_and_names(tmp_path):
    source = tmp_path / "in.npz"
    target = tmp_path / "out.npz"
    normals = NEAR_ORIGIN.astype(np.float32)
    rows = np.arange(20)
    arrays: dict[str, Any] = {"xyz": NEAR_ORIGIN, "normals": normals, "my name": normals[:, 0]}
    np.savez(source, allow_pickle=False, **arrays)
    table = contents(source)
    # numpy.savez takes no array of this name
    columns = {**table.columns, "file": rows}

    write(target, replace(table, columns=columns))

    again = np.load(target)
    assert set(again) == {"xyz", "normals", "my name", "file"}
    assert_array_equal(again["file"], rows)
    for name, array in arrays.items():
        assert again[name].dtype == array.dtype
        assert_array_equal(again[name], array)


def test_arrays_of_npz_that_are_left_out_are_said(tmp_path, capsys):
    source = tmp_path / "in.npz"
    np.savez(source, points=NEAR_ORIGIN, pose=np.eye(4), names=["a"] * 20)

    write(tmp_path / "out.ply", contents(source))

    assert "out.ply: without pose, names" in capsys.readouterr().out
