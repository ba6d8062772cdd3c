"""Text files."""

import pytest
from numpy.testing import assert_array_equal

from mops_lightning.data.formats.registry import read
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
    assert_array_equal(contents(path).points, [[1, 2, 3], [4, 5, 6]])


def test_obj_faces_after_tab_make_a_mesh(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf\t1 2 3\n")
    assert len(read(tmp_path / "a.obj", 70, 0).points) == 70
