import pytest

from tests.support.meshes import BALL, BOX, scaled, write_mesh


@pytest.fixture
def mesh_layout(tmp_path):
    """ModelNet's layout: two classes, three training and two test meshes."""
    root = tmp_path / "set"
    for name, mesh in (("box", BOX), ("ball", BALL)):
        train = root / name / "train" / f"{name}_1.off"
        test = root / name / "test" / f"{name}_3.OFF"
        large = scaled(mesh, 10)
        small = scaled(mesh, 2)
        write_mesh(train, large)
        write_mesh(test, small, file_type="off")
    second_box = root / "box" / "train" / "box_2.ply"
    write_mesh(second_box, BOX)
    (root / "box" / "readme.txt").write_text("not a mesh")
    return root
