"""The clouds on which a task net is scored: crops of files, with their classes or parts."""

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mops_lightning.data.crops import random_crops
from mops_lightning.data.features import feature_values, with_channels
from mops_lightning.data.formats.registry import read
from mops_lightning.errors import UserError
from mops_lightning.files.task_net.subject import Subject
from mops_lightning.ops.points import normalize_unit_sphere
from mops_lightning.seeding import derive_seed, generator
from mops_lightning.types import UNKNOWN, Batch

CHOOSING = "choosing"
CHECKING = "checking"
HALVES = (CHOOSING, CHECKING)
"""Halves of the files: methods are chosen on the first, and checked on the second."""

BATCH = 32
"""Clouds that the net sees together."""


@dataclass(frozen=True)
class Source:
    """One file of a comparison.

    Attributes:
        path: the file.
        points: ``(N, 3)`` its finite points.
        values: ``(N, C)`` the net's channels in the units of the file; None without channels.
        parts: ``(N,)`` positions among the net's parts, or ``UNKNOWN``; None without parts.
        label: position of its class.
        half: one of ``HALVES``.
    """

    path: Path
    points: NDArray[np.float64]
    values: NDArray[np.float64] | None
    parts: NDArray[np.int64] | None
    label: int
    half: str


def read_sources(
    files: Sequence[Path],
    subject: Subject,
    seed: int,
    columns: Sequence[str] | None,
) -> list[Source]:
    """Read all files.

    Args:
        files: of the comparison.
        subject: says what the net needs of them.
        seed: of the points on meshes, and of the halves.
        columns: names of the columns of .bin files; None: those that their names imply.

    Raises:
        UserError: a file lacks what the net needs, or has too few points.
    """
    classes = class_names(files, subject)
    labels = [_label(path, classes, subject) for path in files]
    halves = _halves(labels, seed)
    sources = []
    n_points = subject.n_points
    surface = max(10_000, 8 * n_points)
    for path, label, half in zip(files, labels, halves, strict=True):
        table = read(path, surface, seed, columns=columns).finite()
        number = len(table.points)
        if number < n_points:
            raise UserError(
                f"{path} has {number:,} points, fewer than the {n_points:,} of "
                "a cloud. Lower --points, or remove the file."
            )
        values = None
        if subject.channels:
            values = feature_values(table, subject.channels.features, path, "--task-net")
        parts = None
        if subject.label is not None:
            parts = table.whole_numbers(subject.label, path)
            if subject.outputs:
                parts = _positions(parts, subject, path)
        sources.append(Source(path, table.points, values, parts, label, half))
    return sources


def class_names(files: Sequence[Path], subject: Subject) -> list[str]:
    """Return the classes of the files: those of the net, or the names of the files' folders."""
    if subject.needs_classes:
        return list(subject.outputs)
    return sorted({path.absolute().parent.name for path in files})


def _label(path: Path, classes: Sequence[str], subject: Subject) -> int:
    """Return the position of a file's class: the nearest folder above it with a class's name."""
    for folder in path.absolute().parents:
        if folder.name in classes:
            return classes.index(folder.name)
    shown = ", ".join(classes[:5])
    if len(classes) > 5:
        shown += ", ..."
    raise UserError(
        f"{path}: no folder above it is a class of {subject.name}: {shown}. Put every file into a "
        "folder of its class."
    )


def _halves(labels: Sequence[int], seed: int) -> list[str]:
    """Share files between two halves, those of every class alike."""
    rng = np.random.default_rng(derive_seed(seed, 7))
    order = rng.permutation(len(labels)).tolist()
    order.sort(key=lambda place: labels[place])
    halves = [""] * len(labels)
    for rank, place in enumerate(order):
        halves[place] = HALVES[rank % 2]
    return halves


def _positions(numbers: NDArray[np.int64], subject: Subject, path: Path) -> NDArray[np.int64]:
    """Return the positions of part numbers among the net's parts.

    The parts of a run on files are named by their numbers. Parts with other names are numbered
    from 0 in the net's order.
    """
    names = subject.outputs
    if all(name.isdecimal() for name in names):
        known = np.array([int(name) for name in names], np.int64)
    else:
        known = np.arange(len(names))
    is_given = numbers >= 0
    unknown = numbers[is_given & ~np.isin(numbers, known)]
    if len(unknown):
        known_numbers = ", ".join(map(str, known[:9].tolist()))
        raise UserError(
            f"{path}: {len(unknown):,} points have a {subject.label} that {subject.name} does not "
            f"know, such as {unknown[0]}; it knows {known_numbers}. Give "
            "them a number below 0."
        )
    order = known.argsort()
    places = np.searchsorted(known, numbers, sorter=order)
    found = order[places.clip(max=len(known) - 1)]
    positions: NDArray[np.int64] = np.where(is_given, found, UNKNOWN)
    return positions


def batches(
    sources: Sequence[Source], subject: Subject, half: str, seed: int
) -> Iterator[tuple[Any, torch.Tensor]]:
    """Draw the clouds of one half of the files.

    Args:
        sources: all files.
        subject: the net.
        half: one of ``HALVES``.
        seed: of this draw.

    Yields:
        What ``Task.step`` takes, and the points to sample: ``(B, N, 3 + C)``, of pairs both clouds.
    """
    members = [source for source in sources if source.half == half]
    per_batch = max(1, BATCH // subject.crops)
    for first in range(0, len(members), per_batch):
        of_batch = members[first : first + per_batch]
        drawn = [_draw(source, subject, seed) for source in of_batch]
        seed_of_batch = derive_seed(seed, HALVES.index(half), first)
        yield from _joined(drawn, subject, seed_of_batch)


def _draw(source: Source, subject: Subject, seed: int) -> Batch:
    """Draw the clouds of one file, as in training."""
    number_of_file = zlib.crc32(source.path.name.encode())
    rng = np.random.default_rng(derive_seed(seed, number_of_file))
    drawn = random_crops(
        source.points, subject.n_points, subject.crops, subject.crop, rng, source.path
    )
    points = normalize_unit_sphere(torch.from_numpy(drawn.points))
    if source.values is not None:
        points = with_channels(points, source.values[drawn.rows], subject.channels)
    parts = None
    if source.parts is not None:
        parts = torch.from_numpy(source.parts[drawn.rows])
    labels = torch.full((subject.crops,), source.label)
    return Batch(points, labels, None, parts)


def _joined(
    drawn: Sequence[Batch], subject: Subject, seed: int
) -> Iterator[tuple[Any, torch.Tensor]]:
    """Put clouds of files together, in batches of ``BATCH``."""
    points = torch.cat([batch.points for batch in drawn])
    labels = torch.cat([batch.labels for batch in drawn])
    known = [batch.parts for batch in drawn if batch.parts is not None]
    parts = None
    if known:
        parts = torch.cat(known)
    for first in range(0, len(points), BATCH):
        of_batch = slice(first, first + BATCH)
        clouds = points[of_batch]
        if subject.task.make_batch is not None:
            places = range(first, first + len(clouds))
            generators = [generator(seed, place) for place in places]
            pairs = subject.task.make_batch(clouds, generators)
            yield pairs, pairs.points
            continue
        parts_of_batch = None
        if parts is not None:
            parts_of_batch = parts[of_batch]
        yield Batch(clouds, labels[of_batch], None, parts_of_batch), clouds
