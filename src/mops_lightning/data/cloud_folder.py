"""Data sets of files: scans, clouds of single objects, meshes and sequences of meshes."""

import hashlib
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.data.cloud_files import (
    Content,
    Reading,
    append_features,
    read_clouds,
    with_progress,
)
from mops_lightning.data.clouds import CloudDataset, Clouds, choose_classes, make_dataset
from mops_lightning.data.crops import Crop
from mops_lightning.data.file_splits import (
    SPLITS,
    SourceFile,
    class_of,
    list_files,
    split_by_folder,
    split_by_share,
    split_by_time,
)
from mops_lightning.data.formats.mesh import SUFFIXES as MESHES
from mops_lightning.data.formats.registry import READABLE
from mops_lightning.data.surfaces import VERSION, sample_surface
from mops_lightning.errors import UserError, check_at_least
from mops_lightning.filesystem import remove_temporary
from mops_lightning.types import UNKNOWN

CONSEQUENCE = {"train": "never learned", "test": "never scored"}
"""What happens to a class without files in a split."""


def cloud_folder(
    root: str | Path,
    n_points: int | None = 1024,
    classes: Sequence[str] | None = None,
    test_share: float = 0.2,
    gap: int = 0,
    seed: int = 0,
    cache: str | Path | None = None,
    *,
    # No defaults: a record without these is evaluated with the values of its preset.
    test_frames: Literal["last"] | None,
    crop: Crop,
    crops: int | None,
    label: str | None = None,
    columns: Sequence[str] | None = None,
    features: Sequence[str] | None = None,
) -> CloudDataset:
    """Read the clouds or meshes in a folder and its subfolders, one per file.

    A file is in one split only. The split comes from ``test_frames``; else from folders named
    ``train`` and ``test``; else a random share of the files of every class is the test split.

    Args:
        root: the folder. The first folder of a path is the class, if there is one.
        n_points: number of points per cloud. None keeps all points of every file, with ``whole``:
            clouds then have different sizes, see ``loader.CloudLoader``.
        classes: names to keep; None or empty means all.
        test_share: share of test files in a class, between 0 and 1.
        gap: number of frames between training and test frames that are not used, because
            neighbouring frames are almost identical.
        seed: seed of the split and the points.
        cache: folder for sampled surfaces, found by file content, ``n_points`` and ``seed``; None
            disables the cache.
        test_frames: ``last`` for sequences, whose frames are in the order of their numbers: the
            last frames of every class are the test split.
        crop: ``nearest`` takes the points nearest to a drawn point, as the tiles of ``downsample
            --tile``; ``whole`` random points of the cloud; ``surface`` random points on the
            surface of a mesh, uniform by area; ``tiles`` cuts the cloud, so that every point of
            a file is in one tile, whose label counts. Tiles that would have fewer points are
            filled up by points of their neighbours, whose parts are unknown there.
        crops: number of clouds per file; 1 for ``surface``. None: 32 crops, or one whole cloud,
            which then counts once per epoch, or as many tiles as the points fill.
        label: column of the files that says to which part a point belongs, by a whole number, below
            0 if that is unknown; None: the points have no parts. Not with ``surface``.
        columns: names of the columns of .bin files, which have no header; None: those that their
            names imply. Not with ``surface``.
        features: names of columns that nets see as channels beside x, y and z, in this order.
            ``normals`` and ``curvature`` are estimated where a file has no such columns. Not with
            ``surface``.

    Returns:
        Float32 clouds ``(S, N, 3 + C)`` in the unit sphere, with the centroid at the origin.
        Channels have mean 0 and standard deviation 1 over the training clouds; normals have length
        1; ``channels`` has the statistics. Classes are in alphabetical order. ``notes`` has the
        number of files per split. The fingerprint depends on the content of the files and the
        arguments, not on ``root``.

    Raises:
        UserError: an argument or a file is invalid, or a split is empty.
    """
    if not 0 < test_share < 1:
        raise UserError(f"test_share must be between 0 and 1, got {test_share}.")
    if test_frames not in (None, "last"):
        raise UserError(f"test_frames must be last or null, got {test_frames!r}.")
    check_at_least(0, gap=gap)
    reading = Reading.of(n_points, crop, crops, seed, label, columns, features)

    folder = Path(root).expanduser()
    suffixes = MESHES if crop == "surface" else READABLE
    names = list_files(folder, suffixes)
    known = sorted({class_of(name) for name in names})
    class_names = choose_classes(classes, known)
    names = [name for name in names if class_of(name) in class_names]
    if test_frames == "last":
        files = [file for file in split_by_time(names, test_share, gap) if file.split]
    else:
        files = split_by_folder(names) or split_by_share(names, test_share, seed)
    notes = _notes(folder, files, class_names)
    if crop == "surface":
        assert n_points is not None  # Reading.of refuses it
        contents = _read_meshes(folder, files, n_points, seed, cache)
        splits = _clouds_of_splits(contents, class_names)
        fingerprint = _fingerprint_of_meshes(contents, n_points, seed, class_names)
        return CloudDataset(class_names, splits["train"], splits["test"], fingerprint, notes)
    contents = read_clouds(folder, files, reading)
    contents, channels = append_features(contents, reading.features)
    numbers = _known_numbers(contents)
    splits = _clouds_of_splits(contents, class_names, numbers)
    dataset = make_dataset("clouds", splits, class_names, None, folder, channels=channels)
    part_names = tuple(str(number) for number in numbers.tolist())
    return replace(dataset, notes=notes, part_names=part_names)


def _read_meshes(
    folder: Path,
    files: Sequence[SourceFile],
    n_points: int,
    seed: int,
    cache: str | Path | None,
) -> list[Content]:
    """Sample the surface of every mesh."""
    kept = None
    if cache:
        kept = Path(cache).expanduser()
        remove_temporary(kept, below=False)
    contents = []
    for file in with_progress(files):
        digest, cloud = sample_surface(folder / file.name, n_points, seed, kept)
        contents.append(Content(file, cloud[None], digest=digest))
    return contents


def _known_numbers(contents: Sequence[Content]) -> NDArray[np.int64]:
    """Return the part numbers of all files in ascending order, without unknown ones."""
    found: set[int] = set()
    for content in contents:
        if content.numbers is not None:
            found.update(np.unique(content.numbers).tolist())
    known = [number for number in sorted(found) if number >= 0]
    return np.array(known, np.int64)


def _clouds_of_splits(
    contents: Sequence[Content],
    class_names: Sequence[str],
    numbers: NDArray[np.int64] | None = None,
) -> dict[str, Clouds]:
    """Put the clouds of the files together, split by split.

    Args:
        contents: what was read.
        class_names: in the order of the labels.
        numbers: of the parts, in the order of their positions; None: there are no parts.
    """
    splits = {}
    for split in SPLITS:
        rows = []
        members = []
        for row, content in enumerate(contents):
            if content.file.split == split:
                rows.append(row)
                members.append(content)
        splits[split] = _joined(members, rows, class_names, numbers)
    return splits


def _joined(
    members: Sequence[Content],
    rows: Sequence[int],
    class_names: Sequence[str],
    numbers: NDArray[np.int64] | None,
) -> Clouds:
    """Join the clouds of one split, whose files are the given rows among all files."""
    counts = torch.tensor([len(content.clouds) for content in members])
    labels = torch.tensor([class_names.index(content.file.class_name) for content in members])
    lengths = torch.tensor([content.clouds.shape[1] for content in members])
    most = int(lengths.max())
    points = [_repeated(content.clouds, most) for content in members]
    sources = None
    if counts.gt(1).any():
        sources = torch.tensor(rows).repeat_interleave(counts)
    parts = None
    numbers_of_points = [content.numbers for content in members if content.numbers is not None]
    if numbers_of_points:
        assert numbers is not None
        positions = [_parts(found, numbers) for found in numbers_of_points]
        parts = torch.cat([_repeated(position, most) for position in positions])
    sizes = None
    if (lengths != lengths[0]).any():
        sizes = lengths.repeat_interleave(counts)
    return Clouds(
        torch.cat(points),
        labels.repeat_interleave(counts),
        sources,
        parts,
        sizes,
    )


def _repeated(values: Tensor, number: int) -> Tensor:
    """Return ``(crops, n, ...)`` values with rows repeated until there are ``number``."""
    own = values.shape[1]
    if own == number:
        return values
    columns = torch.arange(number) % own
    return values[:, columns]


def _parts(found: NDArray[np.int64], numbers: NDArray[np.int64]) -> Tensor:
    """Return the position of every part number among the known ones, or ``UNKNOWN``."""
    positions = np.searchsorted(numbers, found)
    return torch.from_numpy(np.where(found < 0, UNKNOWN, positions))


def _fingerprint_of_meshes(
    contents: Sequence[Content], n_points: int, seed: int, class_names: tuple[str, ...]
) -> str:
    """Hash the files and the arguments, so that the sampled points need not be read."""
    settings = ("meshes", VERSION, n_points, seed, class_names)
    digest = hashlib.sha256(repr(settings).encode())
    for content in contents:
        file = content.file
        entry = (file.split, str(file.name), content.digest)
        digest.update(repr(entry).encode())
    return digest.hexdigest()


def _notes(
    folder: Path, files: Sequence[SourceFile], class_names: tuple[str, ...]
) -> dict[str, Any]:
    """Return facts for the run record; print which classes are missing in a split.

    Raises:
        UserError: a split has no file.
    """
    notes: dict[str, Any] = {}
    for split in SPLITS:
        members = [file for file in files if file.split == split]
        if not members:
            raise UserError(
                f"root: {folder} has no {split} file of {', '.join(class_names)}: give at least "
                "two files, because a file is in one split only."
            )
        notes[f"{split}_files"] = len(members)
        found = {file.class_name for file in members}
        missing = [name for name in class_names if name not in found]
        if missing:
            notes[f"classes_without_{split}_files"] = missing
            names = ", ".join(missing)
            print(f"{folder}: no {split} file of {names}: {CONSEQUENCE[split]}.", file=sys.stderr)
    return notes
