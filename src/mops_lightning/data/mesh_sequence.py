"""Mesh sequences of captured motion, split by time."""

import re
from collections.abc import Sequence
from pathlib import Path, PurePath, PurePosixPath
from typing import Literal

from mops_lightning.data.clouds import CloudDataset, choose_classes
from mops_lightning.data.mesh_io import SUFFIXES
from mops_lightning.data.mesh_sampling import mesh_root, sample_meshes
from mops_lightning.errors import UserError, did_you_mean

TEST_FRAMES = ("last", "spread")


def mesh_sequence(
    root: str | Path,
    n_points: int = 40960,
    classes: Sequence[str] | None = None,
    test_share: float = 0.2,
    gap: int = 2,
    seed: int = 0,
    cache: str | Path | None = None,
    workers: int = 1,
    test_frames: Literal["last", "spread"] = "last",
) -> CloudDataset:
    """Sample the frames of sequences, such as ``SEQUENCE/FRAME.ply``.

    Neighbouring frames are almost identical, so that a random split would test on training data.
    By default, the last frames of every sequence are the test split, and the frames just before
    them belong to neither split. ``test_frames="spread"`` tests poses between those of the
    training, which is easier.

    Args:
        root: a folder with one folder per sequence; the sequences are the classes.
        n_points: number of points per frame, uniform by area.
        classes: sequences to keep; None or empty means all.
        test_share: share of test frames in a sequence, between 0 and 1; at least one frame.
        gap: number of frames between training and test frames that are not used; with ``spread``,
            on either side of every test frame.
        seed: seed of the sampling.
        cache: folder for sampled clouds; None disables the cache.
        workers: number of processes that read meshes.
        test_frames: ``last`` takes the last frames of a sequence, ``spread`` frames at equal
            distances.

    Returns:
        Float32 clouds ``(S, n_points, 3)`` in the unit sphere, with the centroid at the origin.

    Raises:
        UserError: an argument or a file is invalid.
    """
    if not 0 < test_share < 1:
        raise UserError(f"test_share must be between 0 and 1, got {test_share}.")
    if test_frames not in TEST_FRAMES:
        hint = did_you_mean(test_frames, TEST_FRAMES)
        raise UserError(f"test_frames: unknown {test_frames!r}.{hint}")
    minima = {
        "n_points": (n_points, 1),
        "gap": (gap, 0),
        "seed": (seed, 0),
        "workers": (workers, 1),
    }
    folder = mesh_root(root, minima)
    sequences = {path.name: _frames(path) for path in sorted(folder.iterdir()) if path.is_dir()}
    sequences = {name: frames for name, frames in sequences.items() if frames}
    if not sequences:
        raise UserError(
            f"root: no mesh in {folder}. Looked for SEQUENCE/* ending in {', '.join(SUFFIXES)}."
        )
    rows: list[tuple[PurePosixPath, str]] = []
    for name in choose_classes(classes, list(sequences)):
        frames = sequences[name]
        splits = _split_frames(folder / name, len(frames), test_share, gap, test_frames)
        paths = [PurePosixPath(frame.relative_to(folder).as_posix()) for frame in frames]
        rows += [(path, split) for path, split in zip(paths, splits, strict=True) if split]
    return sample_meshes(folder, rows, classes, n_points, seed=seed, cache=cache, workers=workers)


def _frames(sequence: Path) -> list[Path]:
    """Return the meshes of a sequence in the order of their numbers."""
    frames = (path for path in sequence.iterdir() if path.suffix.lower() in SUFFIXES)
    return sorted(frames, key=by_number)


def _split_frames(
    sequence: Path, frames: int, test_share: float, gap: int, test_frames: str
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
