"""PCD files."""

import base64

import numpy as np
import pytest

from mops_lightning.data.formats import pcd
from mops_lightning.data.formats.pcd import decompress_lzf
from mops_lightning.data.formats.registry import read
from mops_lightning.errors import UserError

PACKED = (
    "2LJ$oKL7v#K%fJl0$>wB4!{@S0vq56C*TGnz&k)!;0pub17qL_XW$BZ;0uf31fSpwPv8Rv-~+qh19#v9^WXvp-~_A"
    "S2KV3uU*HEj;0F8P154lsTi^iK;R7?_21DTkm*5Dq;Rg%g4iDiB58w<E00H100{{Zx9s>Xa;2r}"
)
"""The points of ``test_pcd_every_encoding_is_read`` in LZF as PCL writes it: longest matches."""
HEAD = (
    "FIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 40\nHEIGHT 1\nPOINTS 40\n"
)


def test_pcd_every_encoding_is_read(tmp_path):
    random = np.random.default_rng(1)
    points = random.integers(0, 3, (40, 3)).astype("<f4")
    colour = np.repeat(np.arange(4, dtype="<u4"), 10)
    rows = np.empty(40, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
    rows["x"], rows["y"], rows["z"], rows["rgb"] = *points.T, colour
    fields = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in ["x", "y", "z", "rgb"])
    small = base64.b85decode(PACKED)
    sizes = np.array([len(small), len(fields)], "<u4").tobytes()
    text = "\n".join(" ".join(str(value) for value in row) for row in rows.tolist())
    bodies = {"ascii": text.encode(), "binary": rows.tobytes(), "binary_compressed": sizes + small}
    for kind, body in bodies.items():
        path = tmp_path / f"{kind}.pcd"
        path.write_bytes(f"# comment\nVERSION .7\n{HEAD}DATA {kind}\n".encode() + body)
        table = pcd.read(path)
        np.testing.assert_array_equal(table.points, points)
        np.testing.assert_array_equal(table.columns["rgb"], colour)


@pytest.mark.parametrize(
    ("number", "body"),
    [
        (99999999999, b"ascii\n"),
        (1, b"binary_compressed\n" + np.array([9, 4], "<u4").tobytes() + b"\0a"),
    ],
)
def test_pcd_impossible_count_is_broken(number, body, tmp_path):
    path = tmp_path / "a.pcd"
    head = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 1\nPOINTS {number}\nDATA "
    path.write_bytes(head.encode() + body)
    with pytest.raises(UserError, match=rf"bytes are not {number} points"):
        read(path, 9, 0)


def test_lzf_repeats_and_stops_at_its_size():
    assert decompress_lzf(b"\0a\xe0\x02\0\x01bc\x40\x01", 1 + 11 + 2 + 4) == b"a" * 12 + b"bcbcbc"
    with pytest.raises(ValueError, match="expected 12"):
        decompress_lzf(b"\0a" + b"\xe0\xff\0" * 100_000, 12)


def test_pcd_fields_of_several_numbers_are_kept(tmp_path):
    head = "FIELDS x y z fpfh\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 2\nWIDTH 3\nPOINTS 3\n"
    lines = "".join(f"{row} 0 0 {row}.5 {row}.25\n" for row in range(3))
    (tmp_path / "a.pcd").write_text(f"{head}DATA ascii\n{lines}")
    table = read(tmp_path / "a.pcd", 9, 0)
    assert list(table.columns) == ["fpfh_0", "fpfh_1"]
    assert table.columns["fpfh_1"].tolist() == [0.25, 1.25, 2.25]
