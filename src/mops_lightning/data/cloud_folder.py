"""Data sets of files: scans, clouds of single objects, meshes and sequences of meshes."""

import hashlib
import re
import sys
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePath, PurePosixPath
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from torch import Tensor

from mops_lightning.data.clouds import CloudDataset, Clouds, choose_classes, make_dataset
from mops_lightning.data.formats.guard import BadCloudError
from mops_lightning.data.formats.mesh import SUFFIXES as MESHES
from mops_lightning.data.formats.registry import READABLE, read
from mops_lightning.data.surfaces import VERSION, sample_surface
from mops_lightning.errors import UserError, check_at_least, did_you_mean
from mops_lightning.filesystem import remove_temporary
from mops_lightning.ops.points import normalize_unit_sphere
from mops_lightning.seeding import derive_seed
from mops_lightning.types import UNKNOWN

Crop = Literal["nearest", "whole", "surface"]
CROPS = ("nearest", "whole", "surface")

SPLITS = ("train", "test")

DRAWS = 50
"""Crops that are drawn before a file is rejected because all points of a crop coincide."""


def cloud_folder(
    root: str | Path,
    n_points: int = 1024,
    classes: Sequence[str] | None = None,
    test_share: float = 0.2,
    gap: int = 0,
    seed: int = 0,
    cache: str | Path | None = None,
    *,
    # No defaults: a record without these is evaluated with the values of its preset.
    test_frames: Literal["last"] | None,
    crop: Crop,
    crops: int,
    label: str | None = None,
) -> CloudDataset:
    """Read the clouds or meshes in a folder and its subfolders, one per file.

    A file is in one split only. The split comes from ``test_frames``; else from folders named
    ``train`` and ``test``; else a random share of the files of every class is the test split.

    Args:
        root: the folder. The first folder of a path is the class, if there is one.
        n_points: number of points per cloud.
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
            surface of a mesh, uniform by area.
        crops: number of clouds per file; 1 for ``surface``.
        label: column of the files that says to which part a point belongs, by a whole number, below
            0 if that is unknown; None: the points have no parts. Not with ``surface``.

    Returns:
        Float32 clouds ``(S, n_points, 3)`` in the unit sphere, with the centroid at the origin, and
        classes in alphabetical order. ``notes`` has the number of files per split. The fingerprint
        depends on the content of the files and the arguments, not on ``root``.

    Raises:
        UserError: an argument or a file is invalid, or a split is empty.
    """
    check_at_least(2, n_points=n_points)
    check_at_least(1, crops=crops)
    check_at_least(0, seed=seed, gap=gap)
    if test_frames not in (None, "last"):
        raise UserError(f"test_frames must be last or null, got {test_frames!r}.")
    if not 0 < test_share < 1:
        raise UserError(f"test_share must be between 0 and 1, got {test_share}.")
    if crop not in CROPS:
        raise UserError(f"crop: unknown {crop!r}.{did_you_mean(crop, CROPS)}")
    if crop == "surface" and crops != 1:
        raise UserError(f"crops must be 1 with crop=surface, got {crops}.")
    if crop == "surface" and label is not None:
        raise UserError(f"label must be null with crop=surface, got {label!r}.")
    folder = Path(root).expanduser()
    suffixes = MESHES if crop == "surface" else READABLE
    names = list_files(folder, suffixes)
    chosen = choose_classes(classes, sorted(set(map(class_of, names))))
    names = [name for name in names if class_of(name) in chosen]
    if test_frames is not None:
        splits = split_by_time(names, test_share, gap)
        names = [name for name, split in zip(names, splits, strict=True) if split]
        splits = [split for split in splits if split]
    else:
        splits = split_by_folder(names) or split_by_share(names, test_share, seed)
    notes = _notes(folder, names, splits, chosen)
    crops_of, digests, labels_of = _read_files(
        folder, names, n_points, crop, crops, seed, cache, label
    )
    numbers = np.unique(np.concatenate(labels_of)) if labels_of else np.empty(0, np.int64)
    numbers = numbers[numbers >= 0]
    parts_of = [np.where(one < 0, UNKNOWN, np.searchsorted(numbers, one)) for one in labels_of]
    clouds = {}
    for split in SPLITS:
        rows = [row for row, of_file in enumerate(splits) if of_file == split]
        labels = torch.tensor([chosen.index(class_of(names[row])) for row in rows])
        clouds[split] = Clouds(
            torch.cat([crops_of[row] for row in rows]),
            labels.repeat_interleave(crops),
            torch.tensor(rows).repeat_interleave(crops) if crops > 1 else None,
            torch.from_numpy(np.concatenate([parts_of[row] for row in rows])) if parts_of else None,
        )
    if crop != "surface":
        dataset = make_dataset("clouds", clouds, chosen, None, folder)
        return replace(dataset, notes=notes, part_names=tuple(map(str, numbers.tolist())))
    digest = hashlib.sha256(repr(("meshes", VERSION, n_points, seed, chosen)).encode())
    for path, split, of_file in zip(names, splits, digests, strict=True):
        digest.update(repr((split, str(path), of_file)).encode())
    return CloudDataset(chosen, clouds["train"], clouds["test"], digest.hexdigest(), notes)


def list_files(folder: Path, suffixes: Sequence[str]) -> list[PurePosixPath]:
    """Return the relative paths of the files with these suffixes below a folder, sorted."""
    names = sorted(
        PurePosixPath(path.relative_to(folder).as_posix())
        for path in folder.rglob("*")
        if path.suffix.lower() in suffixes and path.is_file()
    )
    names = [name for name in names if not any(part.startswith(".") for part in name.parts)]
    if not names:
        raise UserError(f"root: no file in or below {folder} ends in {', '.join(suffixes)}.")
    return names


def _read_files(
    folder: Path,
    names: list[PurePosixPath],
    n_points: int,
    crop: Crop,
    crops: int,
    seed: int,
    cache: str | Path | None,
    label: str | None,
) -> tuple[list[Tensor], list[str], list[NDArray[np.int64]]]:
    """Sample the surfaces of meshes, or draw crops of clouds.

    Returns:
        The clouds of every file, ``(crops, n_points, 3)``, the sha256 of every mesh's file, and the
        labels of every cloud file's points, ``(crops, n_points)``, if ``label`` names them.
    """
    kept = Path(cache).expanduser() if cache else None
    if kept is not None:
        remove_temporary(kept, below=False)
    console = Console(stderr=True)
    clouds, digests, labels = [], [], []
    for name in track(names, "Reading files", console=console, disable=not console.is_terminal):
        path = folder / name
        if crop == "surface":
            digest, cloud = sample_surface(path, n_points, seed, kept)
            clouds.append(cloud[None])
            digests.append(digest)
            continue
        rng = np.random.default_rng(derive_seed(seed, zlib.crc32(str(name).encode())))
        table = read(path, max(10_000, 8 * n_points), seed).finite()
        drawn, rows = random_crops(table.points, n_points, crops, crop, rng, path)
        clouds.append(normalize_unit_sphere(torch.from_numpy(drawn)))
        if label is not None:
            labels.append(table.whole_numbers(label, path)[rows])
    return clouds, digests, labels


def random_crops(
    points: NDArray[np.float64],
    n_points: int,
    number: int,
    crop: Crop,
    rng: np.random.Generator,
    path: Path,
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Draw crops of a cloud ``(N, 3)``: ``(number, n_points, 3)``, each with its centroid at 0.

    Returns:
        The crops, and the rows ``(number, n_points)`` of their points.

    Raises:
        BadCloudError: the cloud has fewer than ``n_points`` points, or they coincide.
    """
    if len(points) < n_points:
        raise BadCloudError(
            f"{path} has {len(points)} points, fewer than dataset.n_points={n_points}. Lower "
            "dataset.n_points, or remove the file."
        )
    crops = np.empty((number, n_points, 3), np.float32)
    chosen = np.empty((number, n_points), np.int64)
    for place in range(number):
        for _ in range(DRAWS):
            if crop == "nearest":
                distance = np.square(points - points[rng.integers(len(points))]).sum(1)
                rows = np.sort(np.argpartition(distance, n_points - 1)[:n_points])
            else:
                rows = rng.choice(len(points), n_points, replace=False)
            drawn = points[rows]
            if (drawn != drawn[0]).any():
                break
        else:
            raise BadCloudError(f"{path}: the {n_points} points of a crop coincide. Clean it.")
        # Before float32, which has too few digits for coordinates of a map.
        crops[place], chosen[place] = drawn - drawn.mean(0), rows
    return crops, chosen


def _notes(
    folder: Path, names: list[PurePosixPath], splits: list[str], classes: tuple[str, ...]
) -> dict[str, Any]:
    """Return facts for the run record; print which classes are missing in a split.

    Raises:
        UserError: a split has no file.
    """
    notes: dict[str, Any] = {}
    for split, consequence in zip(SPLITS, ("never learned", "never scored"), strict=True):
        found = {
            class_of(name) for name, of_file in zip(names, splits, strict=True) if of_file == split
        }
        missing = [name for name in classes if name not in found]
        if not found:
            raise UserError(
                f"root: {folder} has no {split} file of {', '.join(classes)}: give at least two "
                "files, because a file is in one split only."
            )
        notes[f"{split}_files"] = splits.count(split)
        if missing:
            notes[f"classes_without_{split}_files"] = missing
            print(
                f"{folder}: no {split} file of {', '.join(missing)}: {consequence}.",
                file=sys.stderr,
            )
    return notes


def split_by_time(names: Sequence[PurePosixPath], test_share: float, gap: int) -> list[str]:
    """Test the last frames of every sequence; arguments as in ``cloud_folder``.

    Returns:
        A split per file: ``train``, ``test``, or an empty one for files in the gap.

    Raises:
        UserError: ``gap`` leaves a sequence no training frame.
    """
    splits = [""] * len(names)
    for sequence in sorted({class_of(name) for name in names}):
        members = [i for i, name in enumerate(names) if class_of(name) == sequence]
        members.sort(key=lambda i: (names[i].parent.parts, by_number(names[i])))
        n_test = max(round(len(members) * test_share), 1)
        before = len(members) - n_test
        if gap >= before:
            raise UserError(
                f"gap must leave training frames, got {gap}: {sequence} has {len(members)} "
                f"frame(s), {n_test} of them for the test. Use a gap below {before}, or a smaller "
                "test_share."
            )
        of_sequence = ["train"] * (before - gap) + [""] * gap + ["test"] * n_test
        for i, split in zip(members, of_sequence, strict=True):
            splits[i] = split
    return splits


def by_number(path: PurePath) -> tuple[list[tuple[int, str]], str]:
    """Return a sort key that puts frame_9 before frame_10."""
    parts = re.split(r"(\d+)", path.stem)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts], path.name


def split_by_folder(names: Sequence[PurePosixPath]) -> list[str] | None:
    """Return the splits of files in ``train/`` and ``test/``, or None if there are none.

    The folder may be the first or the second: ``train/FILE``, ``CLASS/train/FILE`` and so on.

    Raises:
        UserError: some files are in a folder of a split and others are not.
    """
    splits = [next((part for part in name.parts[:-1][:2] if part in SPLITS), "") for name in names]
    if not any(splits):
        return None
    if "" in splits:
        raise UserError(
            f"root: {names[splits.index('')]} is neither in train/ nor in test/, but other files "
            "are. Move it into one of them."
        )
    return splits


def class_of(name: PurePosixPath) -> str:
    """Return the first folder of a path that is not a split's, or ``cloud``."""
    return next((part for part in name.parts[:-1][:2] if part not in SPLITS), "cloud")


def split_by_share(names: Sequence[PurePosixPath], test_share: float, seed: int) -> list[str]:
    """Draw a share of the files of every class as the test split.

    Args:
        names: of the files.
        test_share: share of test files in a class; at least one file of two.
        seed: of the draw.

    Returns:
        A split per file: ``train`` or ``test``.
    """
    classes = [class_of(name) for name in names]
    splits = ["train"] * len(names)
    for label, of_class in enumerate(sorted(set(classes))):
        members = [i for i, name in enumerate(classes) if name == of_class]
        order = np.random.default_rng(derive_seed(seed, label)).permutation(len(members))
        number = max(round(len(members) * test_share), 1) if len(members) > 1 else 0
        for place in order[:number]:
            splits[members[place]] = "test"
    return splits
