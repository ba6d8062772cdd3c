"""Text files."""

import pytest
from numpy.testing import assert_array_equal

from mops_lightning.data.formats.registry import read
from mops_lightning.errors import UserError
from tests.support.cloud_files import contents


@pytest.mark.parametrize(
    "text",
    [
        "1 2 3\n4 5 6\n",
        "1,2,3\n4,5,6\n",
        "x;y;z\n1;2;3\n4;5;6\n",
        "# a\n// b\n1\t2\t3\n4 5 6",
        "\ufeff1 2 3\n4 5 6\n",
        "1 2 3 # first\n4 5 6 # second\n",
        "I X Y Z\n9 1 2 3\n9 4 5 6\n",
        "//Z;X;Y\n3;1;2\n6;4;5\n",
        "2\n1 2 3\n4 5 6\n",
        "a b c\n1 2 3\n4 5 6\n",
    ],
)
def test_text_dialect_is_read(text, tmp_path):
    path = tmp_path / "a.xyz"
    path.write_text(text, encoding="utf-8")

    table = contents(path)

    assert_array_equal(table.points, [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize(("comments", "name"), [(19, "height"), (20, "column_3")])
def test_text_names_of_columns_are_in_one_of_the_first_twenty_lines(comments, name, tmp_path):
    path = tmp_path / "a.xyz"
    before = "# a remark\n" * comments
    path.write_text(f"{before}# x y z height\n1 2 3 4\n5 6 7 8\n")

    table = contents(path)

    assert list(table.columns) == [name]
    assert table.columns[name].tolist() == [4, 8]


def test_text_equal_names_and_names_in_quotes_become_different_columns(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text('x y z a a "two words"\n1 2 3 4 5 6\n7 8 9 10 11 12\n')

    columns = contents(path).columns

    assert list(columns) == ["a", "a_", "two words"]
    assert columns["a"].tolist() == [4, 10]
    assert columns["a_"].tolist() == [5, 11]
    assert columns["two words"].tolist() == [6, 12]


def test_text_may_have_more_points_than_it_announces_but_not_fewer(tmp_path):
    path = tmp_path / "a.xyz"
    path.write_text("2\n1 2 3\n4 5 6\n7 8 9\n")

    table = contents(path)

    assert len(table.points) == 3
    path.write_text("3\n1 2 3\n4 5 6\n")
    with pytest.raises(UserError, match="announces 3 points, but has 2"):
        contents(path)


def test_text_comment_in_another_encoding_is_left_out(tmp_path):
    path = tmp_path / "a.txt"
    path.write_bytes("# Höhe in m\n1 2 3\n4 5 6\n".encode("latin-1"))

    assert contents(path).points.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_obj_faces_after_tab_make_a_mesh(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf\t1 2 3\n")

    table = read(path, 70, 0)

    assert len(table.points) == 70
