"""Text files of scanners: .pts and .ptx."""

import pytest

from mops_lightning.errors import UserError
from tests.support.cloud_files import contents

SCAN = (
    "2\n2\n1 2 3\n1 0 0\n0 1 0\n0 0 1\n"
    "0 1 0 0\n-1 0 0 0\n0 0 1 0\n100 200 300 1\n"
    "1 0 0 0.5 255 0 0\n0 1 0 0.25 0 255 0\n0 0 0 0.5 0 0 0\n0 0 1 1 0 0 255\n"
)
"""Four cells, the third without a return, turned about z by a quarter and moved."""


def test_read_ptx_applies_the_pose_and_leaves_empty_cells_out(tmp_path):
    (tmp_path / "a.ptx").write_text(SCAN)

    table = contents(tmp_path / "a.ptx").finite()

    assert table.points.tolist() == [[100, 201, 300], [99, 200, 300], [100, 200, 301]]
    assert table.columns["intensity"].tolist() == [0.5, 0.25, 1]
    assert table.columns["blue"].tolist() == [0, 0, 255]
    assert "scan" not in table.columns


def test_read_ptx_of_several_scans_numbers_them(tmp_path):
    (tmp_path / "a.ptx").write_text(SCAN + SCAN.replace("100 200 300 1", "0 0 0 1"))

    table = contents(tmp_path / "a.ptx").finite()

    assert table.columns["scan"].tolist() == [0, 0, 0, 1, 1, 1]
    assert table.points[3].tolist() == [0, 1, 0]


@pytest.mark.parametrize(
    ("row", "names"),
    [
        ("1 2 3", []),
        ("1 2 3 -1200", ["intensity"]),
        ("1 2 3 10 20 30", ["red", "green", "blue"]),
        ("1 2 3 -1200 10 20 30", ["intensity", "red", "green", "blue"]),
    ],
)
def test_read_pts_knows_columns_by_their_number(row, names, tmp_path):
    (tmp_path / "a.pts").write_text(f"3\n{row}\n{row}\n{row}\n")

    table = contents(tmp_path / "a.pts")

    assert table.points.tolist() == [[1, 2, 3]] * 3
    assert list(table.columns) == names


def test_read_pts_of_several_blocks_is_one_cloud(tmp_path):
    (tmp_path / "a.pts").write_text("1\n1 2 3 7\n2\n4 5 6 8\n7 8 9 9\n")

    assert contents(tmp_path / "a.pts").columns["intensity"].tolist() == [7, 8, 9]


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.pts", "3\n1 2 3\n", "announces 3 points, but has 1"),
        ("a.pts", "", "holds no points"),
        ("a.pts", "1\n1 2 3 4 5\n", "got 5 numbers in a line"),
        ("a.ptx", "", "is empty"),
        ("a.ptx", "2\n2\n", "ends in the header"),
        ("a.ptx", SCAN.rsplit("\n", 2)[0], "announces 4 points, but has 3"),
        ("a.ptx", SCAN.replace("2\n2\n", "99999\n99999\n", 1), "announces 9999800001 points"),
    ],
)
def test_broken_file_is_named(name, text, said, tmp_path):
    (tmp_path / name).write_text(text)

    with pytest.raises(UserError, match=rf"{name}.*{said}"):
        contents(tmp_path / name)
