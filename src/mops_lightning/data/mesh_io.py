"""One mesh file to one cloud; without torch, so that worker processes start quickly."""

import hashlib
import re
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from mops_lightning.errors import UserError
from mops_lightning.files import atomic_write

SUFFIXES = (".off", ".obj", ".ply", ".stl", ".glb")
VERSION = 1
"""Part of the cached files' names; raise it when the same file would give another cloud."""

FLAT = 1e-12
"""Area over squared extent under which a mesh is a line or a point, up to rounding."""


class BrokenMeshError(UserError):
    """A mesh file without a readable surface; the one error that ``skip_broken`` skips."""


Result = tuple[str, NDArray[np.float32]] | BrokenMeshError


def cloud_or_error(path: Path, n_points: int, seed: int, cache: Path | None) -> Result:
    """Do as ``cloud_from_file``, but return a broken mesh's error, so that others can go on."""
    try:
        return cloud_from_file(path, n_points, seed, cache)
    except BrokenMeshError as error:
        return error


def cloud_from_file(
    path: Path, n_points: int, seed: int, cache: Path | None = None
) -> tuple[str, NDArray[np.float32]]:
    """Sample a mesh file's surface and put the cloud into the unit sphere.

    The random numbers hang on ``seed`` and the file's bytes, so a mesh gives the same cloud in
    whatever folder and order it is met.

    Args:
        path: a file with one of ``SUFFIXES``.
        n_points: points to sample, uniform by area.
        seed: not negative.
        cache: folder that keeps sampled clouds under a name made from the file's bytes and the
            settings, or None.

    Returns:
        sha256 of the file's bytes, and the cloud ``(n_points, 3)``: centroid at the origin, the
        farthest point at distance 1.

    Raises:
        BrokenMeshError: the file cannot be read, or holds no surface.
        UserError: the cache cannot be written.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise BrokenMeshError(f"{path} cannot be read: {error}.") from error
    digest = hashlib.sha256(data).hexdigest()
    key = repr((VERSION, digest, path.suffix.lower(), n_points, seed))
    kept = cache / f"{hashlib.sha256(key.encode()).hexdigest()}.npy" if cache else None
    if kept is not None and (points := _recall(kept, n_points)) is not None:
        return digest, points
    mesh = parse_mesh(data, path)
    random = np.random.default_rng([seed, int(digest[:16], 16)])
    points = unit_sphere(trimesh.sample.sample_surface(mesh, n_points, seed=random)[0])
    if kept is not None:
        try:
            with atomic_write(kept) as temporary:
                np.save(temporary, points)
        except OSError as error:
            raise UserError(f"dataset.cache: cannot write {kept}: {error}.") from error
    return digest, points


def parse_mesh(data: bytes, path: Path) -> trimesh.Trimesh:
    """Read one mesh; a scene's parts are joined, each where its transform puts it.

    ModelNet's headers in which the counts follow ``OFF`` without a line break are understood.

    Args:
        data: the file's bytes.
        path: its name, for the suffix and for errors.

    Returns:
        Triangles with a positive, finite area.

    Raises:
        BrokenMeshError: naming the file and what is wrong with it.
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
            faces = np.asarray(mesh.faces).reshape(-1, 3)
            outside = len(faces) and not 0 <= faces.min() <= faces.max() < len(mesh.vertices)
            area = float(mesh.area) if len(faces) and not outside else 0.0
            extent = float(np.ptp(mesh.triangles, axis=(0, 1)).max()) if area else 0.0
    except Exception as error:  # the parsers raise whatever a broken file makes them stumble over
        raise BrokenMeshError(f"{path} is broken: {type(error).__name__}: {error}.") from error
    if outside:
        raise BrokenMeshError(f"{path} is broken: a face names a vertex that is not there.")
    if not len(faces):
        raise BrokenMeshError(f"{path} holds no faces, so there is no surface to sample.")
    announced = _announced_faces(data, kind)
    if len(faces) < announced:
        raise BrokenMeshError(
            f"{path} is broken: it announces {announced} faces and holds {len(faces)}."
        )
    if not np.isfinite(area):
        raise BrokenMeshError(f"{path} is broken: its vertices are not all finite numbers.")
    if area <= FLAT * extent**2:
        raise BrokenMeshError(f"{path} has a surface of area zero.")
    return mesh


def unit_sphere(points: NDArray[np.floating]) -> NDArray[np.float32]:
    """Move the centroid of ``(N, 3)`` points to the origin and the farthest point to distance 1."""
    points = points - points.mean(axis=0)
    radius = np.linalg.norm(points, axis=1).max()
    return (points / radius if radius > 0 else points).astype(np.float32)


def _load(data: bytes, kind: str) -> trimesh.Trimesh:
    """Let trimesh parse the file and join the parts of a scene."""
    text = kind in (".off", ".obj")
    if kind == ".stl":
        count = int.from_bytes(data[80:84], "little")
        text = len(data) != 84 + 50 * count
        if text and not data.lstrip().startswith(b"solid"):
            raise ValueError(f"{count} triangles take {84 + 50 * count} bytes, not {len(data)}")
    if text:
        # Comments may be in any old encoding, and trimesh guesses it with a package of its own.
        data = data.decode("utf-8" if _is_utf8(data) else "latin-1").encode()
        data = data.replace(b"\t", b" ")  # it knows an OBJ's faces by "f " only
    # Materials have no say in the surface, and their files may be missing.
    extra: dict[str, Any] = {"skip_materials": True} if kind in (".obj", ".glb") else {}
    scene: Any = trimesh.load(
        BytesIO(data), file_type=kind[1:], force="scene", process=False, **extra
    )
    mesh: trimesh.Trimesh = scene.to_mesh()
    return mesh


def _triangles_off(data: bytes) -> trimesh.Trimesh | None:
    """Parse a plain OFF file of triangles, which all of ModelNet is, 5 times faster than trimesh.

    Returns:
        None for any other file: trimesh knows more of the format, or says what is wrong.
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
    return trimesh.Trimesh(vertices, faces[:, 1:], process=False)


def _is_utf8(data: bytes) -> bool:
    try:
        data.decode()
    except UnicodeDecodeError:
        return False
    return True


def _announced_faces(data: bytes, kind: str) -> int:
    """Read the face count in the head of an OFF or PLY file; a cut-off file has fewer faces."""
    head = data[:4096]
    if kind == ".ply":
        counts = re.search(rb"element\s+face\s+(\d+)", head)
    elif kind == ".off":
        counts = re.search(rb"OFF\s*\d+\s+(\d+)", re.sub(rb"#[^\n]*", b"", head))
    else:
        return 0
    return int(counts[1]) if counts else 0


def _recall(path: Path, n_points: int) -> NDArray[np.float32] | None:
    """Load a cached cloud; a damaged one counts as missing and is made again."""
    try:
        points: NDArray[np.float32] = np.load(path)
    except (OSError, ValueError, EOFError):
        return None
    return points if points.shape == (n_points, 3) and points.dtype == np.float32 else None
