"""Splits of a folder of files: by a list, by time, by folders, or by a share of the files."""

import csv
import re
from collections import deque
from collections.abc import Sequence
from pathlib import Path, PurePath, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.seeding import derive_seed

SPLITS = ("train", "test")
TEST_FRAMES = ("last", "spread")

Box = NDArray[np.float64]
"""Lowest and highest coordinates of a cloud, ``(2, 3)``."""

GAP = 0.02
"""Boxes touch when they are at most this share of the smaller one's largest side apart."""

OVERLAP = 0.25
"""Boxes that share more of the smaller one's volume are scans of one place, not tiles."""


def read_split_list(
    root: Path, split_file: Path, suffixes: tuple[str, ...]
) -> dict[PurePosixPath, str]:
    """Read the split of every file in a list; see ``cloud_folder.cloud_folder``.

    Raises:
        UserError: the list cannot be read, or a line is wrong.
    """
    path = split_file if split_file.is_file() else root / split_file
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"split_file: cannot read {split_file}: {error}.") from error
    rows: dict[PurePosixPath, str] = {}
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        fields = [field.strip() for field in next(csv.reader([line]))]
        if fields == ["path", "split"] and not rows:
            continue
        where = f"split_file: {path}, line {number}:"
        if len(fields) != 2 or fields[1] not in SPLITS:
            raise UserError(f"{where} must read 'path,train' or 'path,test', got {line!r}.")
        name = PurePosixPath(fields[0])
        if name.is_absolute() or ".." in name.parts or not name.parts:
            raise UserError(f"{where} the path must be relative to {root}, got {fields[0]!r}.")
        if name.suffix.lower() not in suffixes:
            raise UserError(f"{where} {name} must end in {', '.join(suffixes)}.")
        if name in rows:
            raise UserError(f"{where} {name} is listed twice.")
        if not (root / name).is_file():
            raise UserError(f"{where} {root / name} does not exist.")
        rows[name] = fields[1]
    if not rows:
        raise UserError(f"split_file: {path} lists no file.")
    return rows


def split_by_time(
    names: Sequence[PurePosixPath], test_share: float, gap: int, test_frames: str
) -> list[str]:
    """Split every sequence of frames; arguments as in ``cloud_folder.cloud_folder``.

    Returns:
        A split per file: ``train``, ``test``, or an empty one for files in the gap.

    Raises:
        UserError: ``test_frames`` is unknown, or ``gap`` leaves a sequence no training frame.
    """
    if test_frames not in TEST_FRAMES:
        hint = did_you_mean(test_frames, TEST_FRAMES)
        raise UserError(f"test_frames: unknown {test_frames!r}.{hint}")
    splits = [""] * len(names)
    for sequence in sorted({class_of(name) for name in names}):
        members = [i for i, name in enumerate(names) if class_of(name) == sequence]
        members.sort(key=lambda i: (names[i].parent.parts, by_number(names[i])))
        of_sequence = _split_frames(sequence, len(members), test_share, gap, test_frames)
        for i, split in zip(members, of_sequence, strict=True):
            splits[i] = split
    return splits


def _split_frames(
    sequence: str, frames: int, test_share: float, gap: int, test_frames: str
) -> list[str]:
    """Return the split of every frame of a sequence; frames in the gap have an empty one."""
    n_test = max(round(frames * test_share), 1)
    if test_frames == "last":
        test = list(range(frames - n_test, frames))
    else:  # the middle frame of each of n_test equal parts
        test = [(2 * part + 1) * frames // (2 * n_test) for part in range(n_test)]
    # Distance of every frame from the nearest test frame.
    apart = [min(abs(frame - other) for other in test) for frame in range(frames)]
    if gap >= max(apart):
        largest = max(apart) - 1
        advice = "Reduce test_share, or leave this sequence out (classes)."
        if largest >= 0:
            advice = f"Use a gap of at most {largest}, or a smaller test_share."
        raise UserError(
            f"gap must leave training frames, got {gap}: {sequence} has {frames} frame(s), "
            f"{n_test} of them for the test. {advice}"
        )
    return ["train" if far > gap else "" if far else "test" for far in apart]


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
            "are. Move it, or list the files in dataset.split_file."
        )
    return splits


def class_of(name: PurePosixPath) -> str:
    """Return the first folder of a path that is not a split's, or ``cloud``."""
    return next((part for part in name.parts[:-1][:2] if part not in SPLITS), "cloud")


def split_by_share(
    names: Sequence[PurePosixPath], boxes: Sequence[Box] | None, test_share: float, seed: int
) -> list[str]:
    """Draw a share of the files of every class as the test split.

    Tiles of one scene are drawn next to each other, and training tiles that touch a test tile are
    left out.

    Args:
        names: of the files.
        boxes: of the files; None: no file is a tile.
        test_share: share of test files in a class; at least one file of two.
        seed: of the draw.

    Returns:
        A split per file: ``train``, ``test``, or an empty one for files that are left out.

    Raises:
        UserError: no file is left for one of the splits.
    """
    touching = [[] for _ in names] if boxes is None else neighbouring_tiles(boxes)
    classes = [class_of(name) for name in names]
    splits = ["train"] * len(names)
    for label, of_class in enumerate(sorted(set(classes))):
        members = [i for i, name in enumerate(classes) if name == of_class]
        order = _grown(members, touching, np.random.default_rng(derive_seed(seed, label)))
        number = max(round(len(members) * test_share), 1) if len(members) > 1 else 0
        for i in order[:number]:
            splits[i] = "test"
    tests = {i for i, split in enumerate(splits) if split == "test"}
    splits = [
        "" if split == "train" and tests.intersection(touching[i]) else split
        for i, split in enumerate(splits)
    ]
    for split in SPLITS:
        if split not in splits:
            raise UserError(
                f"root: no {split} file is left of {len(names)}: a file is in one split only, and "
                f"{splits.count('')} of them touch a test tile. Give more files, or list them in "
                "dataset.split_file."
            )
    return splits


def neighbouring_tiles(boxes: Sequence[Box]) -> list[list[int]]:
    """Return the neighbours of every tile: the tiles that touch it.

    A file is a tile of a scene if its box overlaps none of the others by more than ``OVERLAP``:
    scans of one object or one place in motion overlap, tiles meet at their borders.

    Args:
        boxes: F boxes ``(2, 3)``.

    Returns:
        F ascending lists of positions; empty for files that are not tiles.
    """
    low, high = np.stack(boxes, 1)
    touching, is_tile = [], np.ones(len(boxes), bool)
    for i in range(len(boxes)):
        side, own = high - low, high[i] - low[i]
        gap = GAP * np.minimum(side.max(1), own.max()).clip(1e-12)[:, None]
        # With a margin of the gap, flat boxes have a volume.
        shared = np.minimum(high, high[i]) - np.maximum(low, low[i]) + gap
        overlap = (shared.clip(0) / (np.minimum(side, own) + gap)).prod(1)
        others = np.arange(len(boxes)) != i
        is_tile[i] = not (others & (overlap > OVERLAP)).any()
        touching.append(others & (shared >= 0).all(1))
    return [np.flatnonzero(row & is_tile & is_tile[i]).tolist() for i, row in enumerate(touching)]


def _grown(members: list[int], touching: list[list[int]], rng: np.random.Generator) -> list[int]:
    """Return the members in a random order in which tiles follow tiles that they touch."""
    waiting = dict.fromkeys(members[i] for i in rng.permutation(len(members)))
    order: list[int] = []
    near: deque[int] = deque()
    while waiting:
        chosen = near.popleft() if near else next(iter(waiting))
        if chosen in waiting:
            del waiting[chosen]
            order.append(chosen)
            near += [i for i in touching[chosen] if i in waiting]
    return order
