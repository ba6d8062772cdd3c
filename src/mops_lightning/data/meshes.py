"""Datasets of mesh files: ModelNet's folder layout, or any split listed in a file."""

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from mops_lightning.data.clouds import CloudDataset
from mops_lightning.data.mesh_io import SUFFIXES
from mops_lightning.data.mesh_sampling import mesh_root, sample_meshes
from mops_lightning.data.split_list import SPLITS, read_split_list
from mops_lightning.errors import UserError


def meshes(
    root: str | Path,
    n_points: int = 1024,
    classes: Sequence[str] | None = None,
    split_file: str | Path | None = None,
    skip_broken: bool = False,
    seed: int = 0,
    cache: str | Path | None = None,
    workers: int = 1,
) -> CloudDataset:
    """Sample the surfaces of a folder of meshes (off, obj, ply, stl, glb).

    Without ``split_file``, the folder must have the layout of ModelNet, ``CLASS/train/*.off`` and
    ``CLASS/test/*.off``. With it, the class is the first part of each listed path, and files that
    are not listed are ignored. The list has one line per mesh::

        path,split
        chair/chair_0001.off,train
        chair/old/seat.obj,test

    Paths are relative to ``root``, with forward slashes; the split is ``train`` or ``test``. The
    first line is optional. Empty lines and lines that start with ``#`` are ignored.

    Args:
        root: the folder.
        n_points: number of points per mesh, uniform by area.
        classes: names to keep; None or empty means all.
        split_file: path of the list, relative to the working directory or to ``root``; None uses
            the folder layout.
        skip_broken: whether to skip meshes without a readable surface instead of raising an error.
        seed: seed of the sampling.
        cache: folder for sampled clouds, found by file content, ``n_points`` and ``seed``; None
            disables the cache.
        workers: number of processes that read meshes; 1 uses the calling process.

    Returns:
        Float32 clouds ``(S, n_points, 3)`` in the unit sphere, with the centroid at the origin, and
        classes in alphabetical order. ``notes["skipped_meshes"]`` is the number of skipped meshes.
        The fingerprint depends on the content, relative paths and splits of the files, and on the
        arguments.

    Raises:
        UserError: an argument or a file is invalid.
    """
    root = mesh_root(root, {"n_points": (n_points, 1), "seed": (seed, 0), "workers": (workers, 1)})
    if split_file:
        rows = read_split_list(root, Path(split_file).expanduser(), SUFFIXES)
    else:
        rows = _from_layout(root)
    return sample_meshes(
        root,
        rows,
        classes,
        n_points,
        skip_broken=skip_broken,
        seed=seed,
        cache=cache,
        workers=workers,
    )


def _from_layout(root: Path) -> list[tuple[PurePosixPath, str]]:
    """List the meshes of a folder with ModelNet's layout."""
    rows = [
        (PurePosixPath(path.relative_to(root).as_posix()), split)
        for split in SPLITS
        for path in root.glob(f"*/{split}/*")
        if path.suffix.lower() in SUFFIXES and path.is_file() and not path.name.startswith(".")
    ]
    if not rows:
        flat = any(path.suffix.lower() in SUFFIXES for path in root.glob("*/*"))
        hint = (
            " There are meshes in CLASS/*: assign them to splits in a list "
            "(dataset.split_file=FILE on the command line)."
        )
        raise UserError(
            f"root: no mesh in {root}. Looked for CLASS/train/* and CLASS/test/* ending in "
            f"{', '.join(SUFFIXES)}.{hint if flat else ''}"
        )
    return rows
