"""Clouds from the surfaces of mesh files, and a cache of clouds."""

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.data.formats.guard import reading
from mops_lightning.errors import UserError
from mops_lightning.filesystem import atomic_write, load_npz
from mops_lightning.ops.points import UnitSphere

VERSION = 1
"""Part of the cache key; increment it when the same file gives another cloud."""

FLOAT = np.dtype(np.float32)
PART = np.dtype(np.int64)
"""Dtypes of coordinates and of part numbers."""

Kind = tuple[tuple[int, ...], np.dtype[Any]]
"""Shape and dtype of an array."""


def sample_surface(
    path: Path, n_points: int, seed: int, cache: Path | None = None
) -> tuple[str, Tensor]:
    """Sample the surface of a mesh file and normalise the cloud to the unit sphere.

    The random numbers depend on ``seed`` and the content of the file only, so that a mesh gives the
    same cloud in any folder and order.

    The arguments are described in ``cloud_folder.cloud_folder``.

    Returns:
        sha256 of the file's bytes, and the cloud ``(n_points, 3)``, uniform by area.

    Raises:
        BadCloudError: the file cannot be read, or has no surface.
        UserError: the cache cannot be written.
    """
    with reading(path):
        data = path.read_bytes()
    digest = hashlib.sha256(data).hexdigest()
    key = repr((VERSION, digest, path.suffix.lower(), n_points, seed))
    kept = None
    if cache:
        name = hashlib.sha256(key.encode()).hexdigest()
        kept = cache / f"{name}.npz"

    def sample() -> list[NDArray[np.float32]]:
        seed_of_file = int(digest[:16], 16)
        random = np.random.default_rng([seed, seed_of_file])
        from mops_lightning.data.formats.mesh import sample_mesh  # imports the readers

        points = sample_mesh(path, data, n_points, random).points
        sphere = UnitSphere.around(points)
        return [sphere.normalise(points).numpy()]

    kinds = [((n_points, 3), FLOAT)]
    (points,) = cached(kept, kinds, sample)
    return digest, torch.from_numpy(points)


def cached(
    path: Path | None,
    kinds: Sequence[Kind],
    make: Callable[[], list[NDArray[Any]]],
) -> list[NDArray[Any]]:
    """Return clouds, and perhaps their parts, from a cache file, or make them and write the file.

    Args:
        path: the file, an .npz; a missing or damaged one is written again. None: no cache.
        kinds: of the arrays; a file with other ones is replaced.
        make: makes the arrays.

    Raises:
        UserError: the file cannot be written.
    """
    if path is None:
        return make()
    try:
        arrays = list(load_npz(path).values())  # verifies the checksums of the arrays
    except UserError:
        arrays = []
    found = [(array.shape, array.dtype) for array in arrays]
    if found == list(kinds):
        return arrays
    arrays = make()
    try:
        with atomic_write(path) as temporary:
            np.savez(temporary, *arrays)
    except OSError as error:
        raise UserError(
            f"cache: cannot write to {path.parent} ({error}). Set it to a writable folder, or to "
            "None (null on the command line) for no cache."
        ) from error
    return arrays
