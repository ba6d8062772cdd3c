import pytest

from tests.support.meshes import BALL, BOX, scaled, write_mesh


@pytest.fixture
def mesh_layout(tmp_path):
    """ModelNet's layout: two classes, three training and two test meshes."""
    root = tmp_path / "set"
    for name, mesh in (("box", BOX), ("ball", BALL)):
        write_mesh(root / name / "train" / f"{name}_1.off", scaled(mesh, 10))
        write_mesh(root / name / "test" / f"{name}_3.OFF", scaled(mesh, 2), file_type="off")
    write_mesh(root / "box" / "train" / "box_2.ply", BOX)
    (root / "box" / "readme.txt").write_text("not a mesh")
    return root
