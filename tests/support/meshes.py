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
