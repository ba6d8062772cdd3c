"""Splits of a folder of files: by time, by folders, or by a share of the files."""

import re
from collections.abc import Sequence
from pathlib import PurePath, PurePosixPath

import numpy as np

from mops_lightning.errors import UserError
from mops_lightning.seeding import derive_seed

SPLITS = ("train", "test")


def split_by_time(names: Sequence[PurePosixPath], test_share: float, gap: int) -> list[str]:
    """Test the last frames of every sequence; arguments as in ``cloud_folder.cloud_folder``.

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
