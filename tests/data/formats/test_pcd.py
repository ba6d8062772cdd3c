"""PCD files."""

import numpy as np
import pytest

from mops_lightning.data.formats import pcd
from mops_lightning.data.formats.registry import read
from mops_lightning.errors import UserError

HEAD = (
    "FIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 40\nHEIGHT 1\nPOINTS 40\n"
)


def test_pcd_every_encoding_is_read(tmp_path):
    random = np.random.default_rng(1)
    points = random.integers(0, 3, (40, 3)).astype("<f4")
    colour = np.repeat(np.arange(4, dtype="<u4"), 10)
    rows = np.empty(40, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
    rows["x"], rows["y"], rows["z"], rows["rgb"] = *points.T, colour
    text = "\n".join(" ".join(str(value) for value in row) for row in rows.tolist())
    bodies = {"ascii": text.encode(), "binary": rows.tobytes()}
    for kind, body in bodies.items():
        path = tmp_path / f"{kind}.pcd"
        path.write_bytes(f"# comment\nVERSION .7\n{HEAD}DATA {kind}\n".encode() + body)
        table = pcd.read(path)
        np.testing.assert_array_equal(table.points, points)
        np.testing.assert_array_equal(table.columns["rgb"], colour)


def test_pcd_impossible_count_is_broken(tmp_path):
    path = tmp_path / "a.pcd"
    head = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 1\nPOINTS 99999999999\nDATA ascii\n"
    path.write_text(head)
    with pytest.raises(UserError, match="bytes are not 99999999999 points"):
        read(path, 9, 0)


def test_pcd_compressed_names_the_converter(tmp_path):
    path = tmp_path / "a.pcd"
    path.write_text(f"{HEAD}DATA binary_compressed\n")
    with pytest.raises(UserError, match=r"not ascii or binary\. Convert it by .* OUT\.pcd 1"):
        read(path, 9, 0)


def test_pcd_fields_of_several_numbers_are_kept(tmp_path):
    head = "FIELDS x y z fpfh\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 2\nWIDTH 3\nPOINTS 3\n"
    lines = "".join(f"{row} 0 0 {row}.5 {row}.25\n" for row in range(3))
    (tmp_path / "a.pcd").write_text(f"{head}DATA ascii\n{lines}")
    table = read(tmp_path / "a.pcd", 9, 0)
    assert list(table.columns) == ["fpfh_0", "fpfh_1"]
    assert table.columns["fpfh_1"].tolist() == [0.25, 1.25, 2.25]
