"""Sampling many mesh files into the clouds of a dataset."""

import hashlib
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing import get_context
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from mops_lightning.data.clouds import CloudDataset, Clouds, choose_classes
from mops_lightning.data.mesh_io import VERSION, BrokenMeshError, Result, cloud_or_error
from mops_lightning.data.split_list import SPLITS
from mops_lightning.errors import UserError
from mops_lightning.filesystem import remove_temporary


def mesh_root(root: str | Path, minima: dict[str, tuple[int, int]]) -> Path:
    """Check arguments that all datasets of meshes share.

    Args:
        root: path of the folder.
        minima: value and smallest allowed value of other arguments, by name.

    Returns:
        The folder.

    Raises:
        UserError: an argument is too small, or the folder does not exist.
    """
    for name, (value, minimum) in minima.items():
        if value < minimum:
            raise UserError(f"{name} must be at least {minimum}, got {value}.")
    folder = Path(root).expanduser()
    if not folder.is_dir():
        raise UserError(f"root: {folder} is not a folder.")
    return folder


def sample_meshes(
    root: Path,
    rows: Sequence[tuple[PurePosixPath, str]],
    classes: Sequence[str] | None,
    n_points: int,
    skip_broken: bool = False,
    seed: int = 0,
    cache: str | Path | None = None,
    workers: int = 1,
) -> CloudDataset:
    """Sample a list of meshes; see ``meshes`` for most arguments and the result.

    Args:
        root: the folder.
        rows: paths relative to the folder, whose first part is the class, with ``train`` or
            ``test``.
        classes: names to keep; None or empty means all.
        n_points: number of points per mesh.
        skip_broken: whether to skip broken meshes.
        seed: seed of the sampling.
        cache: folder for sampled clouds; None disables the cache.
        workers: number of processes that read meshes.

    Raises:
        UserError: a class is unknown, a mesh is broken, or a split has no mesh.
    """
    chosen = choose_classes(classes, sorted({name.parts[0] for name, _ in rows}))
    rows = sorted(row for row in rows if row[0].parts[0] in chosen)
    digest = hashlib.sha256(repr(("meshes", VERSION, n_points, seed, chosen)).encode())
    clouds: dict[str, list[NDArray[np.float32]]] = {split: [] for split in SPLITS}
    labels: dict[str, list[int]] = {split: [] for split in SPLITS}
    skipped = 0
    folder = Path(cache).expanduser() if cache else None
    if folder is not None:
        remove_temporary(folder, below=False)
    sample = partial(cloud_or_error, n_points=n_points, seed=seed, cache=folder)
    results = _sample_all(sample, [root / name for name, _ in rows], workers)
    for (name, split), result in zip(rows, results, strict=True):
        if isinstance(result, BrokenMeshError):
            if not skip_broken:
                raise UserError(
                    f"{result} Repair or remove the file, or skip broken meshes "
                    "(dataset.skip_broken=true on the command line)."
                ) from result
            skipped += 1
            continue
        digest.update(repr((split, str(name), result[0])).encode())
        clouds[split].append(result[1])
        labels[split].append(chosen.index(name.parts[0]))
    for split in SPLITS:
        if not clouds[split]:
            raise UserError(
                f"root: no {split} mesh of {', '.join(chosen)} in {root} "
                f"({skipped} broken meshes skipped)."
            )
    train, test = (
        Clouds(torch.from_numpy(np.stack(clouds[split])), torch.tensor(labels[split]))
        for split in SPLITS
    )
    notes = {"skipped_meshes": skipped, **_classes_without_meshes(root, chosen, labels)}
    return CloudDataset(chosen, train, test, digest.hexdigest(), notes)


def _classes_without_meshes(
    root: Path, chosen: Sequence[str], labels: dict[str, list[int]]
) -> dict[str, Any]:
    """Return, and print, which classes have no mesh in a split."""
    notes = {}
    for split, consequence in (("train", "never learned"), ("test", "never scored")):
        missing = [name for i, name in enumerate(chosen) if i not in labels[split]]
        if missing:
            notes[f"classes_without_{split}_meshes"] = missing
            print(
                f"{root}: no {split} mesh of {', '.join(missing)}: {consequence}.", file=sys.stderr
            )
    return notes


def _sample_all(sample: partial[Result], paths: list[Path], workers: int) -> Iterator[Result]:
    console = Console(stderr=True)
    bar = partial(
        track,
        description="Sampling meshes",
        total=len(paths),
        console=console,
        disable=not console.is_terminal,
    )
    if workers == 1:
        yield from bar(map(sample, paths))
        return
    # Processes are spawned, because forking after torch has started threads can deadlock. A spawned
    # process imports the module of its function, which therefore does not import torch.
    try:
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            yield from bar(pool.map(sample, paths, chunksize=4))
    except BrokenProcessPool as error:
        raise UserError(
            "workers: a process that read meshes died. Either memory ran out, or the calling "
            "script has no 'if __name__ == \"__main__\":' guard. Try one worker."
        ) from error
