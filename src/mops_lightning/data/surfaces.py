"""Clouds from the surfaces of mesh files."""

import hashlib
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.data.formats.mesh import BrokenMeshError, parse_mesh
from mops_lightning.errors import UserError
from mops_lightning.filesystem import atomic_write

VERSION = 1
"""Part of the cache key; increment it when the same file gives another cloud."""


def sample_surface(
    path: Path, n_points: int, seed: int, cache: Path | None = None
) -> tuple[str, Tensor]:
    """Sample the surface of a mesh file and normalise the cloud to the unit sphere.

    The random numbers depend on ``seed`` and the content of the file only, so that a mesh gives the
    same cloud in any folder and order.

    Args:
        path: a file with one of ``formats.mesh.SUFFIXES``.
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
        return digest, torch.from_numpy(points)
    from trimesh import sample

    mesh = parse_mesh(data, path)
    random = np.random.default_rng([seed, int(digest[:16], 16)])
    points = unit_sphere(np.asarray(sample.sample_surface(mesh, n_points, seed=random)[0]))
    if cached is not None:
        try:
            with atomic_write(cached) as temporary:
                np.save(temporary, points)
        except OSError as error:
            raise UserError(f"cache: cannot write {cached}: {error}.") from error
    return digest, torch.from_numpy(points)


def unit_sphere(points: NDArray[np.float64]) -> NDArray[np.float32]:
    """Centre ``(N, 3)`` points at the origin and scale the largest norm to 1."""
    points = points - points.mean(axis=0)
    radius = np.linalg.norm(points, axis=1).max()
    return (points / radius if radius > 0 else points).astype(np.float32)


def _load_cached(path: Path, n_points: int) -> NDArray[np.float32] | None:
    """Load a cached cloud; return None if it is missing or damaged."""
    try:
        points: NDArray[np.float32] = np.load(path)
    except (OSError, ValueError, EOFError):
        return None
    fits = points.shape == (n_points, 3) and points.dtype == np.float32
    return points if fits else None
