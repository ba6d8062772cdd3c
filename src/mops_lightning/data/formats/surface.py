"""Numbers of the vertices and faces of a mesh at points on its surface."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.table import Column

Mesh = Any
"""A ``trimesh.Trimesh``; its type leaves open what it has after loading."""

NORMALS = ("nx", "ny", "nz")

COLOURS = ("red", "green", "blue", "alpha")


def file_attributes(mesh: Mesh) -> dict[str, Column]:
    """Return the normals and colours of the vertices of a file that trimesh has read."""
    columns: dict[str, Column] = {}
    if "vertex_normals" in mesh._cache.cache:  # otherwise trimesh would compute them
        columns |= dict(zip(NORMALS, np.asarray(mesh.vertex_normals).T, strict=True))
    if mesh.visual.kind == "vertex":
        columns |= dict(zip(COLOURS, np.asarray(mesh.visual.vertex_colors).T, strict=True))
    return columns


def face_colours(mesh: Mesh) -> dict[str, Column]:
    """Return the colours of the faces of a file that trimesh has read."""
    if mesh.visual.kind != "face":
        return {}
    return dict(zip(COLOURS, np.asarray(mesh.visual.face_colors).T, strict=True))


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

    weights = points_to_barycentric(np.asarray(mesh.triangles)[faces], points)
    weights = np.nan_to_num(weights).clip(0, 1)
    corners = np.asarray(mesh.faces)[faces]
    columns = {name: column[faces] for name, column in mesh.face_attributes.items()}
    for name, column in mesh.vertex_attributes.items():
        columns[name] = _at_points(name, column[corners], weights)
    if all(name in mesh.vertex_attributes for name in NORMALS):
        return columns | _unit_normals(columns)
    of_face = np.asarray(mesh.face_normals)[faces].astype(np.float32)
    return columns | dict(zip(NORMALS, of_face.T, strict=True))


def _at_points(name: str, values: Column, weights: NDArray[np.float64]) -> Column:
    """Return numbers ``(n,)`` between those of three corners ``(n, 3)``."""
    if values.dtype.kind == "f" or name in COLOURS:
        mean = (values * weights).sum(1) / weights.sum(1)
        rounded = mean.round() if values.dtype.kind != "f" else mean
        return rounded.astype(values.dtype)
    nearest = weights.argmax(1)
    return values[np.arange(len(values)), nearest]


def _unit_normals(columns: dict[str, Column]) -> dict[str, Column]:
    normals = np.stack([columns[name] for name in NORMALS], 1).astype(np.float64)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    unit = (normals / np.where(lengths > 0, lengths, 1)).astype(np.float32)
    return dict(zip(NORMALS, unit.T, strict=True))
