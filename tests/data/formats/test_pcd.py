"""PCD files."""

import struct

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mops_lightning.data.formats import pcd
from mops_lightning.data.formats.table import Table
from mops_lightning.errors import UserError
from tests.support.cloud_files import contents

HEAD = (
    "FIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 40\nHEIGHT 1\nPOINTS 40\n"
)

COMPRESSED_HEAD = (
    b"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\n"
    b"TYPE F F F\nCOUNT 1 1 1\nWIDTH 20\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 20\n"
    b"DATA binary_compressed\n"
)

COMPRESSED_SIZES = struct.pack("<II", 36, 240)

# Written by Open3D 0.20: ten times (0, 1, 2), then ten times (0.5, -1, 2).
COMPRESSED = bytes.fromhex(
    "010000e02000003f2029e01a0300802023e01c0300bf2027e01a03010040e04103010040"
)


def test_pcd_every_encoding_is_read(tmp_path):
    random = np.random.default_rng(1)
    points = random.integers(0, 3, (40, 3)).astype("<f4")
    colour = np.repeat(np.arange(4, dtype="<u4"), 10)
    rows = np.empty(40, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
    rows["x"] = points[:, 0]
    rows["y"] = points[:, 1]
    rows["z"] = points[:, 2]
    rows["rgb"] = colour
    lines = []
    for row in rows.tolist():
        words = [str(value) for value in row]
        lines.append(" ".join(words))
    text = "\n".join(lines)
    bodies = {"ascii": text.encode(), "binary": rows.tobytes()}
    for kind, body in bodies.items():
        path = tmp_path / f"{kind}.pcd"
        head = f"# comment\nVERSION .7\n{HEAD}DATA {kind}\n"
        path.write_bytes(head.encode() + body)

        table = pcd.read(path)

        assert_array_equal(table.points, points)
        assert_array_equal(table.columns["rgb"], colour)


@pytest.mark.parametrize("height", ["HEIGHT 2\n", ""])
def test_pcd_without_a_number_of_points_has_those_of_its_rows_and_columns(height, tmp_path):
    number = 6 if height else 3
    path = tmp_path / "a.pcd"
    points = np.arange(3.0 * number, dtype="<f4").reshape(number, 3)
    head = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 3\n{height}DATA binary\n"
    path.write_bytes(head.encode() + points.tobytes())

    table = contents(path)

    assert_array_equal(table.points, points)


PADDED_HEAD = (
    "FIELDS x y z _ intensity _ ring\nSIZE 4 4 4 1 4 1 2\nTYPE F F F U F U U\n"
    "COUNT 1 1 1 4 1 10 1\nWIDTH 3\nHEIGHT 1\nPOINTS 3\n"
)
"""The layout of PCL's points, with bytes between the fields that mean nothing."""


def padded_rows():
    rows = np.zeros(
        3,
        [
            ("xyz", "<f4", 3),
            ("first padding", "u1", 4),
            ("intensity", "<f4"),
            ("second padding", "u1", 10),
            ("ring", "<u2"),
        ],
    )
    rows["xyz"] = np.arange(9).reshape(3, 3)
    rows["first padding"] = 1
    rows["intensity"] = [0.5, 0.25, 8]
    rows["second padding"] = 2
    rows["ring"] = [7, 65535, 256]
    return rows


def stored_without_compression(content):
    """Return an LZF stream of literals, with the two sizes before it."""
    stream = b""
    for start in range(0, len(content), 32):
        literal = content[start : start + 32]
        stream += bytes([len(literal) - 1]) + literal
    return struct.pack("<II", len(stream), len(content)) + stream


@pytest.mark.parametrize("kind", ["binary", "binary_compressed"])
def test_pcd_bytes_between_fields_of_different_sizes_are_left_out(kind, tmp_path):
    path = tmp_path / "a.pcd"
    rows = padded_rows()
    body = rows.tobytes()
    if kind == "binary_compressed":  # one field after the other
        x, y, z = rows["xyz"].T
        later_fields = [rows[name] for name in rows.dtype.names[1:]]
        fields = [np.ascontiguousarray(field).tobytes() for field in (x, y, z, *later_fields)]
        body = stored_without_compression(b"".join(fields))
    path.write_bytes(f"{PADDED_HEAD}DATA {kind}\n".encode() + body)

    table = contents(path)

    assert list(table.columns) == ["intensity", "ring"]
    assert table.points.tolist() == [[0, 1, 2], [3, 4, 5], [6, 7, 8]]
    assert table.columns["intensity"].tolist() == [0.5, 0.25, 8]
    assert table.columns["ring"].tolist() == [7, 65535, 256]


def test_pcd_impossible_count_is_broken(tmp_path):
    path = tmp_path / "a.pcd"
    head = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 1\nPOINTS 99999999999\nDATA ascii\n"
    path.write_text(head)

    with pytest.raises(UserError, match="bytes are not 99999999999 points"):
        contents(path)


def test_pcd_unknown_encoding_is_refused(tmp_path):
    path = tmp_path / "a.pcd"
    path.write_text(f"{HEAD}DATA zipped\n")

    with pytest.raises(UserError, match="DATA zipped, not ascii, binary or binary_compressed"):
        contents(path)


def test_pcd_compressed_by_open3d_is_read(tmp_path):
    path = tmp_path / "a.pcd"
    path.write_bytes(COMPRESSED_HEAD + COMPRESSED_SIZES + COMPRESSED)

    table = contents(path)

    first = [[0.0, 1.0, 2.0]] * 10
    second = [[0.5, -1.0, 2.0]] * 10
    assert table.points.tolist() == first + second
    assert table.form.coordinates == np.float32


@pytest.mark.parametrize(
    ("body", "message"),
    [
        pytest.param(COMPRESSED_SIZES[:6], "end early", id="no sizes"),
        pytest.param(COMPRESSED_SIZES + COMPRESSED[:-1], "end early", id="cut"),
        pytest.param(struct.pack("<II", 36, 241) + COMPRESSED, "241 bytes are not 20", id="size"),
    ],
)
def test_pcd_broken_compression_is_refused(tmp_path, body, message):
    path = tmp_path / "a.pcd"
    path.write_bytes(COMPRESSED_HEAD + body)

    with pytest.raises(UserError, match=f"a.pcd is broken: .*{message}"):
        contents(path)


def test_pcd_fields_of_several_numbers_are_kept(tmp_path):
    head = "FIELDS x y z fpfh\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 2\nWIDTH 3\nPOINTS 3\n"
    lines = "".join(f"{row} 0 0 {row}.5 {row}.25\n" for row in range(3))
    path = tmp_path / "a.pcd"
    path.write_text(f"{head}DATA ascii\n{lines}")

    table = contents(path)

    assert list(table.columns) == ["fpfh_0", "fpfh_1"]
    assert table.columns["fpfh_1"].tolist() == [0.25, 1.25, 2.25]


def test_pcd_header_in_small_letters_is_read(tmp_path):
    path = tmp_path / "a.pcd"
    head = "fields x y z t\nsize 4 4 4 2\ntype F F F U\nwidth 2\nheight 1\npoints 2\n"
    path.write_text(f"{head}data ascii\n1 2 3 7\n4 5 6 8\n")

    table = contents(path)

    assert table.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert table.columns["t"].tolist() == [7, 8]


def test_pcd_is_written_with_a_complete_header(tmp_path):
    path = tmp_path / "a.pcd"
    columns = {
        "signed": np.array([-1, 2], np.int16),
        "long": np.array([1, 2**40]),
        "bytes": np.array([3, 4], np.uint8),
        "score": np.array([0.5, 1.5]),
    }

    pcd.write(path, Table(np.arange(6.0).reshape(2, 3), columns))

    head, _, rows = path.read_bytes().partition(b"DATA binary\n")
    assert head.decode().splitlines() == [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS x y z signed long bytes score",
        "SIZE 4 4 4 2 8 1 8",
        "TYPE F F F I I U F",
        "COUNT 1 1 1 1 1 1 1",
        "WIDTH 2",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        "POINTS 2",
    ]
    assert rows == struct.pack("<3fhqBd", 0, 1, 2, -1, 1, 3, 0.5) + struct.pack(
        "<3fhqBd", 3, 4, 5, 2, 2**40, 4, 1.5
    )


def test_pcd_field_whose_name_is_taken_is_written_by_its_numbers(tmp_path):
    source = tmp_path / "a.pcd"
    out = tmp_path / "b.pcd"
    head = "FIELDS x y z f\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 2\nWIDTH 1\nPOINTS 1\n"
    source.write_text(f"{head}DATA ascii\n1 2 3 4 5\n")
    table = contents(source)

    pcd.write(out, table.with_columns({"f": np.array([9.0])}))

    columns = contents(out).columns
    assert {name: column.tolist() for name, column in columns.items()} == {
        "f_0": [4],
        "f_1": [5],
        "f": [9],
    }


def test_pcd_without_a_viewpoint_gets_one_without_a_turn(tmp_path):
    source = tmp_path / "a.pcd"
    out = tmp_path / "b.pcd"
    head = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 1\nPOINTS 1\n"
    source.write_text(f"{head}DATA ascii\n1 2 3\n")

    pcd.write(out, contents(source))

    assert b"\nVIEWPOINT 0 0 0 1 0 0 0\n" in out.read_bytes()
