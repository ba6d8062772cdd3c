"""Mesh files: OFF, OBJ, PLY, STL and GLB, parsed by trimesh."""

import re
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats import ply
from mops_lightning.data.formats.gltf import plain_glb
from mops_lightning.data.formats.guard import BadCloudError, naming_file
from mops_lightning.data.formats.isolated import isolated
from mops_lightning.data.formats.surface import attributes, scene_attributes
from mops_lightning.data.formats.table import Form, Table

if TYPE_CHECKING:
    from trimesh import Trimesh

SUFFIXES = (".off", ".obj", ".ply", ".stl", ".glb")

FLAT = 1e-12
"""Smallest ratio of area to squared extent; below, a mesh is a line or a point."""

LEFT_OUT = "left out"
"""Key of a mesh's metadata: what the file has that a table does not hold."""

MAX_MATERIALS = 1000
"""In an OBJ file with more, materials are ignored: trimesh's time grows with their square."""


def sample_mesh(path: Path, data: bytes, number: int, seed: int | np.random.Generator) -> Table:
    """Sample points on the surface of a mesh, uniform by area.

    Args:
        path: path of the file, for its suffix and for errors.
        data: content of the file.
        number: number of points.
        seed: of the draw.

    Returns:
        The points ``(number, 3)`` with their normals, and with the colours and other numbers of
        vertices and faces; see ``surface.attributes``.

    Raises:
        BadCloudError: the file is not a valid mesh with a surface.
    """
    return isolated(_sample, path, data, number, seed)


def _sample(path: Path, data: bytes, number: int, seed: int | np.random.Generator) -> Table:
    from trimesh.sample import sample_surface

    mesh = parse_mesh(data, path)
    points, faces = sample_surface(mesh, number, seed=seed)
    exact = np.asarray(points, np.float64)
    columns = attributes(mesh, exact, np.asarray(faces))
    form = Form(left_out=mesh.metadata.get(LEFT_OUT, ()))
    return Table(exact, columns, form=form)


def mesh_vertices(path: Path, data: bytes) -> Table:
    """Return the vertices of a mesh with their numbers, in the order of the file.

    Vertices that faces share with different normals may be there several times, except in PLY.

    Raises:
        BadCloudError: the file is not a valid mesh.
    """
    return isolated(_parse_vertices, path, data)


def _parse_vertices(path: Path, data: bytes) -> Table:
    mesh = parse_mesh(data, path)
    left_out = (*mesh.metadata.get(LEFT_OUT, ()), "faces")
    columns = {}
    for name, column in mesh.vertex_attributes.items():
        columns[name] = np.asarray(column)
    points = np.asarray(mesh.vertices, np.float64)
    return Table(points, columns, form=Form(left_out=left_out))


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
        suffixes = ", ".join(SUFFIXES)
        raise BadCloudError(f"{path} must end in {suffixes}.")
    if not data.strip():
        raise BadCloudError(f"{path} is empty.")
    area = 0.0
    extent = 0.0
    with naming_file(path), np.errstate(all="ignore"):
        mesh = _load(data, kind, path)
        faces = _checked_faces(mesh)
        if len(faces):
            area = float(mesh.area)
        if area:
            extents = np.ptp(mesh.triangles, axis=(0, 1))
            extent = float(extents.max())
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


def _checked_faces(mesh: "Trimesh") -> NDArray[np.int64]:
    """Return the faces of a mesh ``(F, 3)``.

    Raises:
        ValueError: vertices have not three coordinates, or a face has no such vertex.
    """
    number, width = mesh.vertices.shape
    if width != 3:
        raise ValueError(f"vertices must have 3 coordinates, got {width}")
    faces = np.asarray(mesh.faces).reshape(-1, 3)
    if len(faces) and not 0 <= faces.min() <= faces.max() < number:
        raise ValueError("a face refers to a vertex that does not exist")
    return faces


def _load(data: bytes, kind: str, path: Path) -> "Trimesh":
    """Parse a file and join the parts of a scene."""
    import trimesh

    if kind == ".ply":
        return _load_ply(data, path)
    data = _prepared(data, kind, path)
    # Materials do not affect the surface, and their files may be missing.
    extra: dict[str, Any] = {}
    if kind != ".off":
        extra["skip_materials"] = True
    scene: Any = trimesh.load(
        BytesIO(data), file_type=kind[1:], force="scene", process=False, **extra
    )
    of_scene = scene_attributes(scene)
    joined: Trimesh = scene.to_mesh()
    joined.vertex_attributes.clear()
    joined.vertex_attributes.update(of_scene.of_vertices)
    joined.face_attributes.clear()
    joined.face_attributes.update(of_scene.of_faces)
    left_out = _left_out(data, kind)
    joined.metadata[LEFT_OUT] = (*left_out, *of_scene.left_out)
    return joined


def _load_ply(data: bytes, path: Path) -> "Trimesh":
    import trimesh

    parsed = ply.parse_mesh(data, path)
    mesh = trimesh.Trimesh(parsed.table.points, parsed.faces, process=False)
    mesh.vertex_attributes.update(parsed.table.columns)
    mesh.face_attributes.update(parsed.face_columns)
    mesh.metadata[LEFT_OUT] = parsed.left_out
    return mesh


def _prepared(data: bytes, kind: str, path: Path) -> bytes:
    """Return the content of a file in a form that trimesh reads well."""
    if kind == ".glb":
        return plain_glb(data, path)
    if kind == ".stl" and not _is_ascii_stl(data):
        return data
    data = _plain_text(data)
    if kind == ".obj" and data.count(b"usemtl") > MAX_MATERIALS:
        data = re.sub(rb"(?m)^[ ]*usemtl.*$", b"", data)
    return data


def _is_ascii_stl(data: bytes) -> bool:
    """Return whether an STL file is text.

    Raises:
        ValueError: it is neither text nor as long as its number of triangles says.
    """
    count = int.from_bytes(data[80:84], "little")
    size = 84 + 50 * count
    if len(data) == size:
        return False
    if not data.lstrip().startswith(b"solid"):
        raise ValueError(f"{count} triangles take {size} bytes, not {len(data)}")
    return True


def _plain_text(data: bytes) -> bytes:
    """Return a text file in UTF-8, with blanks for tabs.

    Comments may have any encoding, for which trimesh would need another package, and it recognises
    faces of OBJ files by "f " only.
    """
    try:
        data.decode()
    except UnicodeDecodeError:
        data = data.decode("latin-1").encode()
    return data.replace(b"\t", b" ")


def _left_out(data: bytes, kind: str) -> tuple[str, ...]:
    """Return what a file has besides the surface and the colours of its vertices and faces."""
    if kind == ".obj" and re.search(rb"(?m)^usemtl ", data):
        return ("materials",)
    if kind == ".glb" and b'"textures"' in data:
        return ("textures",)
    if kind == ".off" and (_has_coloured_vertices(data) or _has_coloured_faces(data)):
        return ("colours",)
    return ()


def _has_coloured_vertices(data: bytes) -> bool:
    """Return whether an OFF file says that its vertices have colours."""
    return re.match(rb"\s*(#[^\n]*\s*)*COFF", data) is not None


def _has_coloured_faces(data: bytes) -> bool:
    """Return whether the last face of an OFF file has numbers behind its corners."""
    without_comments = re.sub(rb"#[^\n]*", b"", data[-4096:])
    words = without_comments.strip().rpartition(b"\n")[2].split()
    return bool(words) and words[0].isdigit() and len(words) > 1 + int(words[0])


def _announced_faces(data: bytes, kind: str) -> int:
    """Return the face count in the header of an OFF file; truncated files have fewer."""
    if kind != ".off":
        return 0
    without_comments = re.sub(rb"#[^\n]*", b"", data[:4096])
    counts = re.search(rb"OFF\s*\d+\s+(\d+)", without_comments)
    if counts is None:
        return 0
    return int(counts[1])
