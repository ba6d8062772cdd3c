"""The loss and the score of a task net from the points that methods choose."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any

import torch
from rich.console import Console
from rich.progress import track
from torchmetrics import Metric

from mops_lightning.errors import UserError
from mops_lightning.files.task_net.clouds import HALVES, Source, batches
from mops_lightning.files.task_net.methods import Method
from mops_lightning.files.task_net.subject import Subject
from mops_lightning.metrics.info import MetricInfo
from mops_lightning.ops.points import gather_points
from mops_lightning.seeding import derive_seed
from mops_lightning.types import TaskOutput

EVERYTHING = "all points"
"""The method that keeps every point."""

ALL = "all"
"""All files, both halves."""

LOSS = MetricInfo("loss", higher_is_better=False)

Key = tuple[str, int]
"""A method and a number of points; 0: all."""


@dataclass(frozen=True)
class Score:
    """One method in one draw.

    Attributes:
        draw: its number.
        files: ``all``, or one of ``HALVES``.
        m: number of points; 0: all.
        method: its name.
        loss: of the task, the sum of its terms; mean over the clouds.
        score: of the task, in the metric's own scale; the loss for a module of the user's own.
        clouds: number of clouds, of pairs both together.
    """

    draw: int
    files: str
    m: int
    method: str
    loss: float
    score: float
    clouds: int


def score_of(subject: Subject) -> MetricInfo:
    """Return the metric by which methods are compared."""
    metrics = subject.task.metrics()
    if not len(metrics):
        return LOSS
    return MetricInfo.of(subject.task.score, metrics[subject.task.score])


class Tally:
    """Sums up the results of one method at one size for one group of files."""

    def __init__(self, subject: Subject) -> None:
        self.net = subject.name
        metrics = subject.task.metrics()
        self.metric: Metric | None = None
        if len(metrics):
            self.metric = metrics[subject.task.score]
        self.total = 0.0
        self.clouds = 0

    def add(self, result: TaskOutput, clouds: int) -> None:
        """Add the result of a batch."""
        loss = float(sum(result.losses.values()))
        self.total += clouds * loss
        self.clouds += clouds
        if self.metric is not None:
            self.metric.update(result.predictions, result.targets)

    def score(self, draw: int, files: str, key: Key) -> Score:
        """Return the means over all batches.

        Raises:
            UserError: the loss or the score is not finite.
        """
        method, m = key
        loss = self.total / self.clouds
        value = loss
        if self.metric is not None:
            value = float(self.metric.compute())
        points = method
        if m:
            points = f"{m:,} points by {method}"
        for what, number in {"loss": loss, "score": value}.items():
            if not isfinite(number):
                raise UserError(
                    f"--task-net: the {what} of {self.net} must be finite; from {points} it is "
                    f"{number}."
                )
        return Score(draw, files, m, method, loss, value, self.clouds)


@torch.no_grad()
def score_methods(
    sources: Sequence[Source],
    subject: Subject,
    methods: Sequence[Method],
    sizes: Sequence[int],
    draws: int,
    seed: int,
) -> Iterator[Score]:
    """Score all methods at all sizes; those of a draw see the same clouds.

    Args:
        sources: files.
        subject: the task.
        methods: that choose the points.
        sizes: numbers of points.
        draws: number of draws of crops and of random choices.
        seed: of the draws.

    Raises:
        UserError: a size is out of range, or the net refuses the points.
    """
    console = Console(stderr=True)
    is_quiet = not console.is_terminal
    numbers = track(range(draws), "Draws", console=console, disable=is_quiet)
    for draw in numbers:
        seed_of_draw = derive_seed(seed, draw)
        tallies: dict[tuple[str, Key], Tally] = {}
        for half in HALVES:
            for batch, points in batches(sources, subject, half, seed_of_draw):
                check_sizes(sizes, points.shape[1], subject)
                samples = _samples(points, methods, sizes, seed_of_draw)
                results = _results(subject, batch, points, samples)
                for key, result in results.items():
                    for files in (ALL, half):
                        tally = tallies.setdefault((files, key), Tally(subject))
                        tally.add(result, batch.num_clouds)
        for (files, key), tally in tallies.items():
            yield tally.score(draw, files, key)


def _samples(
    points: torch.Tensor,
    methods: Sequence[Method],
    sizes: Sequence[int],
    seed: int,
) -> dict[Key, torch.Tensor]:
    """Return the points that every method chooses, and all points."""
    samples = {(EVERYTHING, 0): points}
    for m in sizes:
        for method in methods:
            if method.takes(m):
                rows = method.rows(points, m, seed)
                samples[method.name, m] = gather_points(points, rows)
    return samples


def _results(
    subject: Subject,
    batch: Any,
    points: torch.Tensor,
    samples: Mapping[Key, torch.Tensor],
) -> dict[Key, TaskOutput]:
    """Return the results of the task net.

    Raises:
        UserError: the net refuses the points.
    """
    try:
        return subject.task.scores(batch, samples)
    except (RuntimeError, IndexError, TypeError) as error:
        if isinstance(error, UserError):
            raise
        _, number, columns = points.shape
        reason = " ".join(str(error).split())[:200]
        raise UserError(
            f"--task-net: {subject.name} fails on clouds of {number} points with "
            f"{columns} columns: {reason}"
        ) from None


def check_sizes(sizes: Sequence[int], n_points: int, subject: Subject) -> None:
    """Refuse numbers of points that a cloud does not have.

    Raises:
        UserError: there is one.
    """
    for m in sizes:
        if not 1 <= m <= n_points:
            raise UserError(
                f"--m must be from 1 to {n_points:,}, the points that {subject.name} sees of a "
                f"cloud, got {m}."
            )
