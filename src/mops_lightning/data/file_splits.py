"""Splits of a folder of files: by its folders, or by a share that keeps neighbours together."""

from collections import deque
from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.split_list import SPLITS
from mops_lightning.errors import UserError
from mops_lightning.seeding import derive_seed

Box = NDArray[np.float64]
"""Lowest and highest coordinates of a cloud, ``(2, 3)``."""

GAP = 0.02
"""Boxes touch when they are at most this share of the smaller one's largest side apart."""

OVERLAP = 0.25
"""Boxes that share more of the smaller one's volume are scans of one place, not tiles."""


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
    names: Sequence[PurePosixPath], boxes: Sequence[Box], test_share: float, seed: int
) -> list[str]:
    """Draw a share of the files of every class as the test split.

    Tiles of one scene are drawn next to each other, and training tiles that touch a test tile are
    left out.

    Args:
        names: of the files; the classes are their first folders.
        boxes: of the files.
        test_share: share of test files in a class, between 0 and 1; at least one file of two.
        seed: of the draw.

    Returns:
        A split per file: ``train``, ``test``, or an empty one for files that are left out.

    Raises:
        UserError: no file is left for one of the splits.
    """
    touching = neighbouring_tiles(boxes)
    classes = [class_of(name) for name in names]
    splits = ["train"] * len(names)
    for label, one in enumerate(sorted(set(classes))):
        members = [i for i, name in enumerate(classes) if name == one]
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
        F ascending lists of positions; empty for files that are no tiles.
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
