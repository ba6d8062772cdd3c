"""Mesh files: OFF, OBJ, PLY, STL and GLB, parsed by trimesh."""

import re
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.guard import BadCloudError, naming_file
from mops_lightning.data.formats.isolated import isolated
from mops_lightning.data.formats.ply import plain_header

if TYPE_CHECKING:
    from trimesh import Trimesh

SUFFIXES = (".off", ".obj", ".ply", ".stl", ".glb")

FLAT = 1e-12
"""Smallest ratio of area to squared extent; below, a mesh is a line or a point."""

MAX_MATERIALS = 1000
"""In an OBJ file with more, materials are ignored: trimesh's time grows with their square."""


def sample_mesh(
    path: Path, data: bytes, number: int, seed: int | np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Sample points on the surface of a mesh, uniform by area.

    Args:
        path: path of the file, for its suffix and for errors.
        data: content of the file.
        number: number of points.
        seed: of the draw.

    Returns:
        The points ``(number, 3)``, and the normals of their faces ``(number, 3)``.

    Raises:
        BadCloudError: the file is not a valid mesh with a surface.
    """
    return isolated(_sample, path, data, number, seed)


def _sample(
    path: Path, data: bytes, number: int, seed: int | np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    from trimesh.sample import sample_surface

    mesh = parse_mesh(data, path)
    points, faces = sample_surface(mesh, number, seed=seed)
    return np.asarray(points, np.float64), np.asarray(mesh.face_normals)[faces].astype(np.float32)


def parse_mesh(data: bytes, path: Path) -> "Trimesh":
    """Parse a mesh; the parts of a scene are transformed and joined.

    Headers of ModelNet files with the counts on the same line as ``OFF`` are accepted.

    Args:
        data: content of the file.
        path: path of the file, for its suffix and for errors.

    Returns:
        Triangles with a positive, finite area.

    Raises:
        BadCloudError: the file is not a valid mesh with a surface.
    """
    kind = path.suffix.lower()
    if kind not in SUFFIXES:
        raise BadCloudError(f"{path} must end in {', '.join(SUFFIXES)}.")
    if not data.strip():
        raise BadCloudError(f"{path} is empty.")
    with naming_file(path), np.errstate(all="ignore"):
        mesh = _load(data, kind)
        if mesh.vertices.shape[1] != 3:
            raise ValueError(f"vertices must have 3 coordinates, got {mesh.vertices.shape[1]}")
        faces = np.asarray(mesh.faces).reshape(-1, 3)
        if len(faces) and not 0 <= faces.min() <= faces.max() < len(mesh.vertices):
            raise ValueError("a face refers to a vertex that does not exist")
        area = float(mesh.area) if len(faces) else 0.0
        extent = float(np.ptp(mesh.triangles, axis=(0, 1)).max()) if area else 0.0
    if not len(faces):
        raise BadCloudError(f"{path} has no faces, so there is no surface to sample.")
    announced = _announced_faces(data, kind)
    if len(faces) < announced:
        raise BadCloudError(f"{path} is broken: it has {len(faces)} of {announced} faces.")
    if not np.isfinite(area):
        raise BadCloudError(f"{path} is broken: its vertices are not all finite numbers.")
    if area <= FLAT * extent**2:
        raise BadCloudError(f"{path} has a surface of area zero.")
    return mesh


def _load(data: bytes, kind: str) -> "Trimesh":
    """Parse a file with trimesh and join the parts of a scene."""
    import trimesh

    text = kind in (".off", ".obj")
    if kind == ".stl":
        count = int.from_bytes(data[80:84], "little")
        text = len(data) != 84 + 50 * count
        if text and not data.lstrip().startswith(b"solid"):
            raise ValueError(f"{count} triangles take {84 + 50 * count} bytes, not {len(data)}")
    if text:
        # Comments may have any encoding, for which trimesh would need another package.
        try:
            data.decode()
        except UnicodeDecodeError:
            data = data.decode("latin-1").encode()
        data = data.replace(b"\t", b" ")  # trimesh recognises faces of OBJ files by "f " only
    if kind == ".obj" and data.count(b"usemtl") > MAX_MATERIALS:
        data = re.sub(rb"(?m)^[ ]*usemtl.*$", b"", data)
    if kind == ".ply":
        data = plain_header(data)
    # Materials do not affect the surface, and their files may be missing.
    extra: dict[str, Any] = {"skip_materials": True} if kind != ".off" else {}
    scene: Any = trimesh.load(
        BytesIO(data), file_type=kind[1:], force="scene", process=False, **extra
    )
    mesh: Trimesh = scene.to_mesh()
    return mesh


def _announced_faces(data: bytes, kind: str) -> int:
    """Return the face count in the header of an OFF or PLY file; truncated files have fewer."""
    head = data[:4096]
    if kind == ".ply":
        counts = re.search(rb"element\s+face\s+(\d+)", head)
    elif kind == ".off":
        counts = re.search(rb"OFF\s*\d+\s+(\d+)", re.sub(rb"#[^\n]*", b"", head))
    else:
        return 0
    return int(counts[1]) if counts else 0
