"""Folders of mesh files, sampled into clouds: ModelNet's own form and any other split."""

import csv
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
from mops_lightning.data.mesh_io import SUFFIXES, VERSION, BrokenMeshError, Result, cloud_or_error
from mops_lightning.errors import UserError

SPLITS = ("train", "test")


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

    Without ``split_file`` the folder is laid out as ModelNet's archives are,
    ``CLASS/train/*.off`` and ``CLASS/test/*.off``. With it, the class is the first part of each
    listed path, and files that are not listed are left alone. The list has one line a mesh::

        path,split
        chair/chair_0001.off,train
        chair/old/seat.obj,test

    where paths are relative to ``root`` with forward slashes, the split is ``train`` or ``test``,
    the first line is optional, and empty lines and lines that start with ``#`` do not count.

    Args:
        root: the folder.
        n_points: points to sample from each surface, uniform by area.
        classes: names to keep; None or empty means all.
        split_file: the list, as a path from here or from ``root``; None goes by folder names.
        skip_broken: leave out meshes without a readable surface instead of stopping at them.
        seed: of the sampling.
        cache: folder for the sampled clouds, found again by the files' bytes, ``n_points`` and
            ``seed``; None keeps nothing.
        workers: processes that read meshes; 1 reads them in this one.

    Returns:
        Float32 clouds ``(S, n_points, 3)`` in the unit sphere, centroid at the origin; classes in
        alphabetical order; ``notes["skipped_meshes"]`` counts what was left out. The fingerprint
        hangs on the files' bytes, relative names and splits, and on the settings.

    Raises:
        UserError: naming the setting or the file that is wrong.
    """
    root = mesh_root(root, {"n_points": (n_points, 1), "seed": (seed, 0), "workers": (workers, 1)})
    rows = _listed(root, Path(split_file).expanduser()) if split_file else _laid_out(root)
    return sample_rows(
        root,
        rows,
        classes,
        n_points,
        skip_broken=skip_broken,
        seed=seed,
        cache=cache,
        workers=workers,
    )


def mesh_root(root: str | Path, settings: dict[str, tuple[int, int]]) -> Path:
    """Return the folder, once it is known to be one and the settings are large enough.

    Args:
        root: the folder's path.
        settings: by name, what was given and the least that is allowed.

    Raises:
        UserError: naming the setting.
    """
    for setting, (value, least) in settings.items():
        if value < least:
            raise UserError(f"dataset.{setting} must be at least {least}, got {value}.")
    folder = Path(root).expanduser()
    if not folder.is_dir():
        raise UserError(f"dataset.root: {folder} is not a folder. Set dataset.root=PATH.")
    return folder


def sample_rows(
    root: Path,
    rows: Sequence[tuple[PurePosixPath, str]],
    classes: Sequence[str] | None,
    n_points: int,
    skip_broken: bool = False,
    seed: int = 0,
    cache: str | Path | None = None,
    workers: int = 1,
) -> CloudDataset:
    """Sample the listed meshes; see ``meshes`` for the arguments and what comes back.

    Args:
        root: the folder.
        rows: paths below it, whose first part is the class, each with ``train`` or ``test``.
        classes: names to keep.
        n_points: points of each surface.
        skip_broken: leave out what cannot be read.
        seed: of the sampling.
        cache: folder for the sampled clouds.
        workers: processes that read meshes.
    """
    chosen = choose_classes(classes, sorted({name.parts[0] for name, _ in rows}))
    rows = sorted(row for row in rows if row[0].parts[0] in chosen)
    digest = hashlib.sha256(repr(("meshes", VERSION, n_points, seed, chosen)).encode())
    clouds: dict[str, list[NDArray[np.float32]]] = {split: [] for split in SPLITS}
    labels: dict[str, list[int]] = {split: [] for split in SPLITS}
    skipped = 0
    kept = Path(cache).expanduser() if cache else None
    sample = partial(cloud_or_error, n_points=n_points, seed=seed, cache=kept)
    results = _each(sample, [root / name for name, _ in rows], workers)
    for (name, split), result in zip(rows, results, strict=True):
        if isinstance(result, BrokenMeshError):
            if not skip_broken:
                raise UserError(
                    f"{result} Mend or remove the file, or set dataset.skip_broken=true."
                ) from result
            skipped += 1
            continue
        digest.update(repr((split, str(name), result[0])).encode())
        clouds[split].append(result[1])
        labels[split].append(chosen.index(name.parts[0]))
    for split in SPLITS:
        if not clouds[split]:
            raise UserError(
                f"dataset.root: no {split} mesh of {', '.join(chosen)} in {root} "
                f"({skipped} broken ones skipped)."
            )
    train, test = (
        Clouds(torch.from_numpy(np.stack(clouds[split])), torch.tensor(labels[split]))
        for split in SPLITS
    )
    notes: dict[str, Any] = {"skipped_meshes": skipped}
    for split, consequence in (("train", "never learned"), ("test", "never scored")):
        lacking = [name for i, name in enumerate(chosen) if i not in labels[split]]
        if lacking:
            notes[f"classes_without_{split}_meshes"] = lacking
            print(
                f"{root}: no {split} mesh of {', '.join(lacking)}: {consequence}.", file=sys.stderr
            )
    return CloudDataset(chosen, train, test, digest.hexdigest(), notes)


def _laid_out(root: Path) -> list[tuple[PurePosixPath, str]]:
    rows = [
        (PurePosixPath(path.relative_to(root).as_posix()), split)
        for split in SPLITS
        for path in root.glob(f"*/{split}/*")
        if path.suffix.lower() in SUFFIXES and path.is_file() and not path.name.startswith(".")
    ]
    if not rows:
        flat = any(path.suffix.lower() in SUFFIXES for path in root.glob("*/*"))
        hint = " Its meshes lie in CLASS/ itself: say which is which with dataset.split_file=FILE."
        raise UserError(
            f"dataset.root: no mesh in {root}. Looked for CLASS/train/* and CLASS/test/* ending "
            f"in {', '.join(SUFFIXES)}.{hint if flat else ' Set dataset.root=PATH.'}"
        )
    return rows


def _listed(root: Path, split_file: Path) -> list[tuple[PurePosixPath, str]]:
    path = split_file if split_file.is_file() else root / split_file
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"dataset.split_file: cannot read {split_file}: {error}.") from error
    rows: dict[PurePosixPath, str] = {}
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        fields = [field.strip() for field in next(csv.reader([line]))]
        if fields == ["path", "split"] and not rows:
            continue
        where = f"dataset.split_file: {path}, line {number}:"
        if len(fields) != 2 or fields[1] not in SPLITS:
            raise UserError(f"{where} must read 'path,train' or 'path,test', got {line!r}.")
        name = PurePosixPath(fields[0])
        if name.is_absolute() or ".." in name.parts or len(name.parts) < 2:
            raise UserError(
                f"{where} the path must be CLASS/…/FILE, relative to {root}, got {fields[0]!r}."
            )
        if name.suffix.lower() not in SUFFIXES:
            raise UserError(f"{where} {name} must end in {', '.join(SUFFIXES)}.")
        if name in rows:
            raise UserError(f"{where} {name} is listed twice.")
        if not (root / name).is_file():
            raise UserError(f"{where} {root / name} does not exist.")
        rows[name] = fields[1]
    if not rows:
        raise UserError(f"dataset.split_file: {path} lists no mesh.")
    return list(rows.items())


def _each(sample: partial[Result], paths: list[Path], workers: int) -> Iterator[Result]:
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
    # Forking a process in which torch has started threads can hang. A spawned one cannot; it
    # imports the module of its function, which therefore does without torch.
    try:
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            yield from bar(pool.map(sample, paths, chunksize=4))
    except BrokenProcessPool as error:
        raise UserError(
            "dataset.workers: a process that read meshes died, perhaps for want of memory, or "
            "because the script that started it has no 'if __name__ == \"__main__\":'. "
            "Try dataset.workers=1."
        ) from error
