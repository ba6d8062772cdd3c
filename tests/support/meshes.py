"""Small folders of meshes."""

from pathlib import Path
from typing import Any

import trimesh

BOX = trimesh.creation.box((1.0, 2.0, 3.0))
BALL = trimesh.creation.icosphere(subdivisions=1)


def write_mesh(path: Path, mesh: Any, **options: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    mesh.export(path, **options)
    return path


def scaled(mesh: trimesh.Trimesh, factor: float) -> trimesh.Trimesh:
    return mesh.copy().apply_scale(factor).apply_translation((7, 8, 9))


def modelnet_layout(tmp_path: Path) -> Path:
    """ModelNet's layout: two classes, three training and two test meshes."""
    root = tmp_path / "set"
    for name, mesh in (("box", BOX), ("ball", BALL)):
        write_mesh(root / name / "train" / f"{name}_1.off", scaled(mesh, 10))
        write_mesh(root / name / "test" / f"{name}_3.OFF", scaled(mesh, 2), file_type="off")
    write_mesh(root / "box" / "train" / "box_2.ply", BOX)
    (root / "box" / "readme.txt").write_text("not a mesh")
    return root
