"""Captured motion: folders of meshes, frame after frame, split by time."""

import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from mops_lightning.data.clouds import CloudDataset
from mops_lightning.data.mesh_io import SUFFIXES
from mops_lightning.data.meshes import mesh_root, sample_rows
from mops_lightning.errors import UserError


def mesh_sequence(
    root: str | Path,
    n_points: int = 40960,
    classes: Sequence[str] | None = None,
    test_share: float = 0.2,
    gap: int = 2,
    seed: int = 0,
    cache: str | Path | None = None,
    workers: int = 1,
) -> CloudDataset:
    """Sample the frames of sequences, ``SEQUENCE/FRAME.ply`` and the like.

    Neighbouring frames are almost the same shape, so a random split would test on what was learned.
    Here the last frames of every sequence are the test, and the frames just before them belong to
    neither split.

    Args:
        root: the folder, with one folder for each sequence; these are the classes.
        n_points: points to sample from each surface, uniform by area.
        classes: sequences to keep; None or empty means all.
        test_share: share of a sequence's frames that are tested, at least one.
        gap: frames between training and test that are left out.
        seed: of the sampling.
        cache: folder for the sampled clouds; None keeps nothing.
        workers: processes that read meshes.

    Returns:
        Float32 clouds ``(S, n_points, 3)`` in the unit sphere, centroid at the origin.

    Raises:
        UserError: naming the setting or the file that is wrong.
    """
    if not 0 < test_share < 1:
        raise UserError(f"dataset.test_share must lie between 0 and 1, got {test_share}.")
    least = {"n_points": (n_points, 1), "gap": (gap, 0), "seed": (seed, 0), "workers": (workers, 1)}
    folder = mesh_root(root, least)
    rows: list[tuple[PurePosixPath, str]] = []
    for sequence in sorted(path for path in folder.iterdir() if path.is_dir()):
        frames = sorted(
            (path for path in sequence.iterdir() if path.suffix.lower() in SUFFIXES), key=_by_time
        )
        if not frames:
            continue
        tested = max(round(len(frames) * test_share), 1)
        trained = len(frames) - tested - gap
        if trained < 1:
            raise UserError(
                f"dataset.gap: {sequence} has {len(frames)} frames, of which {tested} are tested "
                f"and {gap} left out; none is left to train on. Lower gap or test_share."
            )
        for number, path in enumerate(frames):
            name = PurePosixPath(path.relative_to(folder).as_posix())
            if number < trained:
                rows.append((name, "train"))
            elif number >= len(frames) - tested:
                rows.append((name, "test"))
    if not rows:
        raise UserError(
            f"dataset.root: no mesh in {folder}. Looked for SEQUENCE/* ending in "
            f"{', '.join(SUFFIXES)}."
        )
    return sample_rows(folder, rows, classes, n_points, seed=seed, cache=cache, workers=workers)


def _by_time(path: Path) -> tuple[list[tuple[int, str]], str]:
    """Sort frame_9 before frame_10."""
    parts = re.split(r"(\d+)", path.stem)
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts], path.name
