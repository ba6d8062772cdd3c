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


WITHOUT_COLOURS = (
    "1\n2\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n4 5 6 0.5\n7 8 9 0.75\n"
)
"""Two cells that have an intensity only."""


def test_read_ptx_without_colours_has_intensities(tmp_path):
    path = tmp_path / "a.ptx"
    path.write_text(WITHOUT_COLOURS)

    table = contents(path)

    assert table.points.tolist() == [[4, 5, 6], [7, 8, 9]]
    assert list(table.columns) == ["intensity"]
    assert table.columns["intensity"].tolist() == [0.5, 0.75]


@pytest.mark.parametrize("text", [SCAN + WITHOUT_COLOURS, WITHOUT_COLOURS + SCAN])
def test_read_ptx_keeps_what_all_scans_have_and_names_the_rest(text, tmp_path):
    path = tmp_path / "a.ptx"
    path.write_text(text)

    table = contents(path)

    assert list(table.columns) == ["intensity", "scan"]
    assert table.form.left_out == ("blue", "green", "red")
    assert len(table.columns["intensity"]) == 6


@pytest.mark.parametrize(
    ("row", "names"),
    [
        ("1 2 3", []),
        ("1 2 3 -1200", ["intensity"]),
        ("1 2 3 10 20 30", ["red", "green", "blue"]),
        ("1 2 3 -1200 10 20 30", ["intensity", "red", "green", "blue"]),
        (
            "1 2 3 -1200 10 20 30 0 0.6 0.8",
            ["intensity", "red", "green", "blue", "nx", "ny", "nz"],
        ),
    ],
)
def test_read_pts_knows_columns_by_their_number(row, names, tmp_path):
    (tmp_path / "a.pts").write_text(f"3\n{row}\n{row}\n{row}\n")

    table = contents(tmp_path / "a.pts")

    values = [float(word) for word in row.split()]
    found = [column[0] for column in table.columns.values()]
    assert table.points.tolist() == [[1, 2, 3]] * 3
    assert list(table.columns) == names
    assert found == values[3:]


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
