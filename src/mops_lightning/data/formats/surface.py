"""Numbers of the vertices and faces of a mesh at points on its surface."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.columns import common_names
from mops_lightning.data.formats.table import Column

Mesh = Any
"""A ``trimesh.Trimesh``; its type leaves open what it has after loading."""

NORMALS = ("nx", "ny", "nz")

COLOURS = ("red", "green", "blue", "alpha")


@dataclass(frozen=True)
class SceneAttributes:
    """The numbers of a scene's vertices and faces, in the order of ``scene.to_mesh()``.

    Attributes:
        of_vertices: normals and colours of the vertices.
        of_faces: colours of the faces.
        left_out: names of columns that a part of the scene lacks.
    """

    of_vertices: dict[str, Column]
    of_faces: dict[str, Column]
    left_out: tuple[str, ...]


def scene_attributes(scene: Any) -> SceneAttributes:
    """Return the normals and colours of all parts of a scene.

    Args:
        scene: a ``trimesh.Scene`` as a file was read, without further processing.
    """
    of_vertices: list[dict[str, Column]] = []
    of_faces: list[dict[str, Column]] = []
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        part = scene.geometry[name]
        if not hasattr(part, "faces"):
            continue
        of_vertices.append(_vertex_attributes(part, transform))
        colours = {}
        if _has_colours(part, "face"):
            colours = _colours(part.visual.face_colors)
        of_faces.append(colours)
    vertices = _joined(of_vertices)
    faces = _joined(of_faces)
    left_out: dict[str, None] = {}
    for columns in (*of_vertices, *of_faces):
        for name in columns:
            if name not in vertices and name not in faces:
                left_out[name] = None
    return SceneAttributes(vertices, faces, tuple(left_out))


def _vertex_attributes(part: Mesh, transform: NDArray[np.float64]) -> dict[str, Column]:
    columns: dict[str, Column] = {}
    if "vertex_normals" in part._cache.cache:  # otherwise trimesh would compute them
        # Under an uneven scale, normals turn the other way than the surface.
        linear = transform[:3, :3]
        normals = np.asarray(part.vertex_normals) @ np.linalg.inv(linear)
        columns |= dict(zip(NORMALS, normals.T, strict=True))
    if _has_colours(part, "vertex"):
        columns |= _colours(part.visual.vertex_colors)
    return columns


def _has_colours(part: Mesh, kind: str) -> bool:
    return bool(part.visual.kind == kind)


def _colours(values: Any) -> dict[str, Column]:
    channels = np.asarray(values).T
    return dict(zip(COLOURS, channels, strict=True))


def _joined(parts: list[dict[str, Column]]) -> dict[str, Column]:
    """Return the columns that all parts have."""
    if not parts:
        return {}
    joined = {}
    for name in common_names(parts):
        joined[name] = np.concatenate([part[name] for part in parts])
    return joined


def attributes(
    mesh: Mesh, points: NDArray[np.float64], faces: NDArray[np.int64]
) -> dict[str, Column]:
    """Return the numbers of points on a surface.

    Floats and colours of vertices are averaged by barycentric weights; of other whole numbers, such
    as labels, the one of the nearest corner is taken. Normals have length 1; without normals of
    vertices they are those of the faces.

    Args:
        mesh: with ``vertex_attributes`` and ``face_attributes``.
        points: ``(n, 3)``.
        faces: ``(n,)`` the face of every point.

    Returns:
        Columns ``(n,)``, of the data types of the mesh's.
    """
    from trimesh.triangles import points_to_barycentric

    triangles = np.asarray(mesh.triangles)[faces]
    barycentric = points_to_barycentric(triangles, points)
    weights = np.nan_to_num(barycentric).clip(0, 1)
    corners = np.asarray(mesh.faces)[faces]
    columns = {name: column[faces] for name, column in mesh.face_attributes.items()}
    for name, column in mesh.vertex_attributes.items():
        columns[name] = _at_points(name, column[corners], weights)
    if all(name in mesh.vertex_attributes for name in NORMALS):
        return columns | _unit_normals(columns)
    face_normals = np.asarray(mesh.face_normals)
    of_face = face_normals[faces].astype(np.float32)
    return columns | dict(zip(NORMALS, of_face.T, strict=True))


def _at_points(name: str, values: Column, weights: NDArray[np.float64]) -> Column:
    """Return numbers ``(n,)`` between those of three corners ``(n, 3)``."""
    is_float = values.dtype.kind == "f"
    if not is_float and name not in COLOURS:
        nearest = weights.argmax(1)
        rows = np.arange(len(values))
        return values[rows, nearest]
    total = (values * weights).sum(1)
    mean = total / weights.sum(1)
    if not is_float:
        mean = mean.round()
    return mean.astype(values.dtype)


def _unit_normals(columns: dict[str, Column]) -> dict[str, Column]:
    axes = [columns[name] for name in NORMALS]
    normals = np.stack(axes, 1).astype(np.float64)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    lengths[lengths == 0] = 1
    unit = (normals / lengths).astype(np.float32)
    return dict(zip(NORMALS, unit.T, strict=True))
