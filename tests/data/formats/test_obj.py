"""OBJ files."""

from mops_lightning.data.formats.registry import read


def test_obj_faces_after_tab_make_a_mesh(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf\t1 2 3\n")
    assert len(read(tmp_path / "a.obj", 70, 0).points) == 70
