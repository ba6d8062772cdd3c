"""Clouds from mesh files; the module imports neither torch nor trimesh: workers start fast."""

import hashlib
import re
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data import glb_bounds, ply_header
from mops_lightning.errors import UserError, one_line
from mops_lightning.filesystem import atomic_write

if TYPE_CHECKING:
    from trimesh import Trimesh

SUFFIXES = (".off", ".obj", ".ply", ".stl", ".glb")
VERSION = 1
"""Part of the cache key; increment it when the same file gives another cloud."""

FLAT = 1e-12
"""Smallest ratio of area to squared extent; below, a mesh is a line or a point."""


MAX_MATERIALS = 1000
"""In an OBJ file with more, materials are ignored: trimesh's time grows with their square."""


class BrokenMeshError(UserError):
    """A mesh file without a readable surface; ``skip_broken`` skips these errors only."""


Result = tuple[str, NDArray[np.float32]] | BrokenMeshError


def cloud_or_error(path: Path, n_points: int, seed: int, cache: Path | None) -> Result:
    """Do the same as ``cloud_from_file``, but return the error of a broken mesh."""
    try:
        return cloud_from_file(path, n_points, seed, cache)
    except BrokenMeshError as error:
        return error


def cloud_from_file(
    path: Path, n_points: int, seed: int, cache: Path | None = None
) -> tuple[str, NDArray[np.float32]]:
    """Sample the surface of a mesh file and normalise the cloud to the unit sphere.

    The random numbers depend on ``seed`` and the content of the file only, so that a mesh gives the
    same cloud in any folder and order.

    Args:
        path: a file with one of ``SUFFIXES``.
        n_points: number of points, uniform by area.
        seed: a non-negative number.
        cache: folder for sampled clouds, found by file content and arguments, or None.

    Returns:
        sha256 of the file's bytes, and the cloud ``(n_points, 3)``: centroid at the origin, the
        farthest point at distance 1.

    Raises:
        BrokenMeshError: the file cannot be read, or has no surface.
        UserError: the cache cannot be written.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise BrokenMeshError(f"{path} cannot be read: {error}.") from error
    digest = hashlib.sha256(data).hexdigest()
    key = repr((VERSION, digest, path.suffix.lower(), n_points, seed))
    cached = cache / f"{hashlib.sha256(key.encode()).hexdigest()}.npy" if cache else None
    if cached is not None and (points := _load_cached(cached, n_points)) is not None:
        return digest, points
    from trimesh.sample import sample_surface

    mesh = parse_mesh(data, path)
    random = np.random.default_rng([seed, int(digest[:16], 16)])
    points = unit_sphere(sample_surface(mesh, n_points, seed=random)[0])
    if cached is not None:
        try:
            with atomic_write(cached) as temporary:
                np.save(temporary, points)
        except OSError as error:
            raise UserError(f"cache: cannot write {cached}: {error}.") from error
    return digest, points


def parse_mesh(data: bytes, path: Path) -> "Trimesh":
    """Parse a mesh; the parts of a scene are transformed and joined.

    Headers of ModelNet files with the counts on the same line as ``OFF`` are accepted.

    Args:
        data: content of the file.
        path: path of the file, for its suffix and for errors.

    Returns:
        Triangles with a positive, finite area.

    Raises:
        BrokenMeshError: the file is not a valid mesh with a surface.
    """
    kind = path.suffix.lower()
    if kind not in SUFFIXES:
        raise BrokenMeshError(f"{path} must end in {', '.join(SUFFIXES)}.")
    if not data.strip():
        raise BrokenMeshError(f"{path} is empty.")
    try:
        with np.errstate(all="ignore"):
            mesh = _triangles_off(data) if kind == ".off" else None
            mesh = _load(data, kind) if mesh is None else mesh
            if mesh.vertices.shape[1] != 3:
                raise ValueError(f"vertices must have 3 coordinates, got {mesh.vertices.shape[1]}")
            faces = np.asarray(mesh.faces).reshape(-1, 3)
            outside = len(faces) and not 0 <= faces.min() <= faces.max() < len(mesh.vertices)
            area = float(mesh.area) if len(faces) and not outside else 0.0
            extent = float(np.ptp(mesh.triangles, axis=(0, 1)).max()) if area else 0.0
    except Exception as error:  # parsers raise many types of exception for broken files
        raise BrokenMeshError(f"{path} is broken: {one_line(error)}.") from error
    if outside:
        raise BrokenMeshError(f"{path} is broken: a face refers to a vertex that does not exist.")
    if not len(faces):
        raise BrokenMeshError(f"{path} has no faces, so there is no surface to sample.")
    announced = _announced_faces(data, kind)
    if len(faces) < announced:
        raise BrokenMeshError(
            f"{path} is broken: its header announces {announced} faces, but it has {len(faces)}."
        )
    if not np.isfinite(area):
        raise BrokenMeshError(f"{path} is broken: its vertices are not all finite numbers.")
    if area <= FLAT * extent**2:
        raise BrokenMeshError(f"{path} has a surface of area zero.")
    return mesh


def unit_sphere(points: NDArray[np.floating]) -> NDArray[np.float32]:
    """Centre ``(N, 3)`` points at the origin and scale the largest norm to 1."""
    points = points - points.mean(axis=0)
    radius = np.linalg.norm(points, axis=1).max()
    return (points / radius if radius > 0 else points).astype(np.float32)


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
        data = data.decode("utf-8" if _is_utf8(data) else "latin-1").encode()
        data = data.replace(b"\t", b" ")  # trimesh recognises faces of OBJ files by "f " only
    if kind == ".obj" and data.count(b"usemtl") > MAX_MATERIALS:
        data = re.sub(rb"(?m)^[ ]*usemtl.*$", b"", data)
    if kind == ".ply":
        data = ply_header.plain(data)
    if kind == ".glb":
        glb_bounds.check(data)
    # Materials do not affect the surface, and their files may be missing.
    extra: dict[str, Any] = {"skip_materials": True} if kind != ".off" else {}
    scene: Any = trimesh.load(
        BytesIO(data), file_type=kind[1:], force="scene", process=False, **extra
    )
    mesh: Trimesh = scene.to_mesh()
    return mesh


def _triangles_off(data: bytes) -> "Trimesh | None":
    """Parse a plain OFF file of triangles, such as ModelNet's, 5 times faster than trimesh.

    Returns:
        The mesh, or None for any other file, which trimesh parses or rejects.
    """
    head = re.match(rb"\s*OFF\s*(\d+)[ \t]+(\d+)[ \t]+\d+\s", data)
    if not head or b"#" in data:
        return None
    n_vertices, n_faces = int(head[1]), int(head[2])
    words = data[head.end() :].split()
    if len(words) != 3 * n_vertices + 4 * n_faces:
        return None
    try:
        vertices = np.array(words[: 3 * n_vertices], dtype=np.float64).reshape(-1, 3)
        faces = np.array(words[3 * n_vertices :], dtype=np.int64).reshape(-1, 4)
    except ValueError:
        return None
    if not (faces[:, 0] == 3).all():
        return None
    from trimesh import Trimesh

    return Trimesh(vertices, faces[:, 1:], process=False)


def _is_utf8(data: bytes) -> bool:
    try:
        data.decode()
    except UnicodeDecodeError:
        return False
    return True


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


def _load_cached(path: Path, n_points: int) -> NDArray[np.float32] | None:
    """Load a cached cloud; return None if it is missing or damaged."""
    try:
        points: NDArray[np.float32] = np.load(path)
    except (OSError, ValueError, EOFError):
        return None
    return points if points.shape == (n_points, 3) and points.dtype == np.float32 else None
