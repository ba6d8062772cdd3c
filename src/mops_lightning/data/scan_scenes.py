"""The scans of a folder's scenes, their pairs with known motions, and their splits."""

from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np

from mops_lightning.data.cloud_folder import cloud_files
from mops_lightning.data.file_splits import split_by_folder
from mops_lightning.data.mesh_sequence import by_number
from mops_lightning.data.motions import PoseRules, ScanPair, read_motions
from mops_lightning.errors import UserError


class Listed(NamedTuple):
    """The scans of all scenes, and their pairs.

    Attributes:
        scans: paths relative to the root, in the order of scenes and names.
        scenes: position of every scan's scene in ``names``.
        names: of the scenes.
        pairs: positions are those in ``scans``.
    """

    scans: list[PurePosixPath]
    scenes: list[int]
    names: list[str]
    pairs: list[ScanPair]


def list_scans(folder: Path, motions: Path, pattern: str | None, poses: PoseRules) -> Listed:
    """Find the scenes of a folder and read their motions; see ``scan_pairs``.

    Args:
        folder: the root.
        motions: file of motions.
        pattern: of the scans' paths in a scene; None: all files that can be read.
        poses: how poses become pairs.

    Raises:
        UserError: a file is missing or wrong, or there is no scan.
    """
    if pattern is not None and (not pattern or Path(pattern).is_absolute()):
        raise UserError(f"scans must be a pattern such as 'velodyne/*.bin', got {pattern!r}.")
    listed = Listed([], [], [], [])
    for place, path in _scene_folders(folder, motions):
        calib = poses.calib and _first_file(poses.calib, folder, place)
        own = {path.resolve(), calib and calib.resolve()}
        names = cloud_files(place, pattern or "*")
        names = [name for name in names if (place / name).resolve() not in own]
        names.sort(key=lambda name: (name.parent.parts, by_number(name)))
        pairs = read_motions(path, len(names), replace(poses, calib=calib))
        first = len(listed.scans)
        inner = PurePosixPath(place.relative_to(folder).as_posix())
        listed.scenes.extend([len(listed.names)] * len(names))
        listed.names.append(str(inner) if inner.parts else folder.resolve().name)
        listed.scans.extend(inner / name for name in names)
        listed.pairs.extend(
            ScanPair(first + pair.source, first + pair.target, pair.motion) for pair in pairs
        )
    return listed


def _scene_folders(folder: Path, motions: Path) -> list[tuple[Path, Path]]:
    """Return the folders of the scenes, each with its file of motions."""
    for path in (motions, folder / motions):
        if path.is_file():
            return [(folder, path)]
    depth = len(motions.parts)
    found = sorted(folder.rglob(motions.name)) if motions.name else []
    found = [path for path in found if path.parts[-depth:] == motions.parts and path.is_file()]
    if not found:
        raise UserError(f"motions: no file {motions}, also not in {folder} or its subfolders.")
    return [(path.parents[depth - 1], path) for path in found]


def _first_file(path: Path, *folders: Path) -> Path:
    """Return a file as given, or in the first of the folders that has it."""
    for one in (path, *(folder / path for folder in folders)):
        if one.is_file():
            return one
    raise UserError(f"calib: no file {path}, also not in {' or '.join(map(str, folders))}.")


def split_scans(listed: Listed, test_share: float) -> list[str]:
    """Return the split of every scan: by folders named ``train`` and ``test``, else by a border.

    The border between training and test scans is where the number of test pairs comes nearest to
    the share; of equal ones, where most training pairs are left.

    Args:
        listed: scans and pairs.
        test_share: share of test pairs, between 0 and 1.

    Raises:
        UserError: no border leaves pairs in both splits.
    """
    by_folder = split_by_folder(listed.scans)
    if by_folder is not None:
        return by_folder
    ends = np.sort([(pair.source, pair.target) for pair in listed.pairs], axis=1)
    borders = np.arange(1, len(listed.scans))
    train = np.searchsorted(np.sort(ends[:, 1]), borders)
    test = len(ends) - np.searchsorted(np.sort(ends[:, 0]), borders)
    off = np.abs(test - test_share * len(ends))
    off[(train == 0) | (test == 0)] = np.inf
    best = np.lexsort((-train, off))[0]
    if not np.isfinite(off[best]):
        raise UserError(
            f"motions: the {len(ends)} pairs of {len(listed.scans)} scans cannot be split, because "
            "a scan is in one split only. Give more scans and pairs, or put scenes into folders "
            "named train and test."
        )
    return ["train" if i < borders[best] else "test" for i in range(len(listed.scans))]
