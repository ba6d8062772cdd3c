"""Mesh sequences of captured motion, split by time."""

import re
from collections.abc import Sequence
from pathlib import Path, PurePath, PurePosixPath
from typing import Literal

from mops_lightning.data.clouds import CloudDataset
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
    rows: list[tuple[PurePosixPath, str]] = []
    for sequence in sorted(path for path in folder.iterdir() if path.is_dir()):
        frames = (path for path in sequence.iterdir() if path.suffix.lower() in SUFFIXES)
        paths = sorted(frames, key=by_number)
        splits = _split_frames(sequence, len(paths), test_share, gap, test_frames)
        names = [PurePosixPath(path.relative_to(folder).as_posix()) for path in paths]
        rows += [(name, split) for name, split in zip(names, splits, strict=True) if split]
    if not rows:
        raise UserError(
            f"root: no mesh in {folder}. Looked for SEQUENCE/* ending in {', '.join(SUFFIXES)}."
        )
    return sample_meshes(folder, rows, classes, n_points, seed=seed, cache=cache, workers=workers)


def _split_frames(
    sequence: Path, frames: int, test_share: float, gap: int, test_frames: str
) -> list[str]:
    """Return the split of every frame of a sequence; frames in the gap have an empty one."""
    if not frames:
        return []
    n_test = max(round(frames * test_share), 1)
    if test_frames == "last":
        test = list(range(frames - n_test, frames))
    else:  # the middle frame of each of n_test equal parts
        test = [(2 * part + 1) * frames // (2 * n_test) for part in range(n_test)]
    splits = ["train"] * frames
    for frame in test:
        begin = max(frame - gap, 0)
        end = frame + gap + 1
        splits[begin:end] = [""] * len(splits[begin:end])
    for frame in test:
        splits[frame] = "test"
    if "train" not in splits:
        raise UserError(
            f"gap must leave training frames, got {gap}: {sequence} has {frames} frames, "
            f"of which {n_test} are test frames. Reduce gap or test_share."
        )
    return splits


def by_number(path: PurePath) -> tuple[list[tuple[int, str]], str]:
    """Return a sort key that puts frame_9 before frame_10."""
    parts = re.split(r"(\d+)", path.stem)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts], path.name
