"""The training and the test files of a folder."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath, PurePosixPath

import numpy as np

from mops_lightning.errors import UserError
from mops_lightning.seeding import derive_seed

SPLITS = ("train", "test")

NO_CLASS = "cloud"
"""Class of the files that are in no folder of a class."""


@dataclass(frozen=True)
class SourceFile:
    """One file of a folder.

    Attributes:
        name: its path in the folder.
        split: ``train`` or ``test``; empty for a file that is in neither.
    """

    name: PurePosixPath
    split: str

    @property
    def class_name(self) -> str:
        """The class of what the file contains."""
        return class_of(self.name)


def list_files(folder: Path, suffixes: Sequence[str]) -> list[PurePosixPath]:
    """Return the relative paths of the files with these suffixes below a folder, sorted.

    Files and folders whose names begin with a dot are left out.

    Raises:
        UserError: there is no such file.
    """
    names = []
    for path in folder.rglob("*"):
        name = PurePosixPath(path.relative_to(folder).as_posix())
        hidden = any(part.startswith(".") for part in name.parts)
        if not hidden and path.suffix.lower() in suffixes and path.is_file():
            names.append(name)
    if not names:
        raise UserError(f"root: no file in or below {folder} ends in {', '.join(suffixes)}.")
    return sorted(names)


def class_of(name: PurePosixPath) -> str:
    """Return the first folder of a path that is not a split's, or ``cloud``."""
    for part in _outer_folders(name):
        if part not in SPLITS:
            return part
    return NO_CLASS


def split_by_time(names: Sequence[PurePosixPath], test_share: float, gap: int) -> list[SourceFile]:
    """Test the last frames of every sequence.

    Args:
        names: of the files; a sequence is a class.
        test_share: share of test frames in a sequence; at least one frame.
        gap: number of frames between training and test frames that are in no split.

    Raises:
        UserError: ``gap`` leaves a sequence no training frame.
    """
    split_of: dict[PurePosixPath, str] = {}
    for sequence in sorted({class_of(name) for name in names}):
        frames = [name for name in names if class_of(name) == sequence]
        frames.sort(key=lambda name: (name.parent.parts, by_number(name)))
        tested = max(round(len(frames) * test_share), 1)
        before = len(frames) - tested
        if gap >= before:
            raise UserError(
                f"gap must leave training frames, got {gap}: {sequence} has {len(frames)} "
                f"frame(s), {tested} of them for the test. Use a gap below {before}, or a smaller "
                "test_share."
            )
        for place, name in enumerate(frames):
            if place < before - gap:
                split_of[name] = "train"
            elif place < before:
                split_of[name] = ""
            else:
                split_of[name] = "test"
    return [SourceFile(name, split_of[name]) for name in names]


def by_number(path: PurePath) -> tuple[list[tuple[int, str]], str]:
    """Return a sort key that puts frame_9 before frame_10."""
    key = []
    for part in re.split(r"(\d+)", path.stem):
        if part.isdecimal():
            key.append((int(part), ""))
        else:
            key.append((-1, part))
    return key, path.name


def split_by_folder(names: Sequence[PurePosixPath]) -> list[SourceFile] | None:
    """Return the splits of files in ``train/`` and ``test/``, or None if there are none.

    The folder may be the first or the second: ``train/FILE``, ``CLASS/train/FILE`` and so on.

    Raises:
        UserError: some files are in a folder of a split and others are not.
    """
    files = [SourceFile(name, _split_folder(name)) for name in names]
    outside = [file.name for file in files if not file.split]
    if len(outside) == len(files):
        return None
    if outside:
        raise UserError(
            f"root: {outside[0]} is neither in train/ nor in test/, but other files are. Move it "
            "into one of them."
        )
    return files


def split_by_share(
    names: Sequence[PurePosixPath], test_share: float, seed: int
) -> list[SourceFile]:
    """Draw a share of the files of every class as the test split.

    Args:
        names: of the files.
        test_share: share of test files in a class; at least one file of two.
        seed: of the draw.
    """
    tested: set[PurePosixPath] = set()
    for label, class_name in enumerate(sorted({class_of(name) for name in names})):
        members = [name for name in names if class_of(name) == class_name]
        if len(members) == 1:
            continue
        number = max(round(len(members) * test_share), 1)
        order = np.random.default_rng(derive_seed(seed, label)).permutation(len(members))
        tested.update(members[place] for place in order[:number])
    files = []
    for name in names:
        split = "test" if name in tested else "train"
        files.append(SourceFile(name, split))
    return files


def _split_folder(name: PurePosixPath) -> str:
    """Return the first folder of a path that is a split's, or an empty name."""
    for part in _outer_folders(name):
        if part in SPLITS:
            return part
    return ""


def _outer_folders(name: PurePosixPath) -> tuple[str, ...]:
    """Return the first two folders of a path, in which class and split are looked for."""
    return name.parts[:-1][:2]
