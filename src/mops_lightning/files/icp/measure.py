"""What registration makes of the points that methods of downsampling choose."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from statistics import fmean, median

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from mops_lightning.errors import UserError
from mops_lightning.files.icp.align import (
    LEAST,
    PoseError,
    Target,
    prepare_source,
    prepare_target,
    timed_error,
)
from mops_lightning.files.icp.methods import Method, Sample
from mops_lightning.files.icp.pairs import Pair, draw_motions
from mops_lightning.seeding import derive_seed

Points = NDArray[np.float64]

ALIGNED = 2.0
"""Degrees of error below which a pair counts as aligned."""

EVERYTHING = "all points"
"""The method that keeps every point."""


@dataclass(frozen=True)
class Setup:
    """How a comparison is made.

    Attributes:
        sizes: numbers of points to keep.
        methods: that choose them.
        registrations: from ``align.REGISTRATIONS``.
        draws: number of draws.
        motions: number of starts of every pair in a draw.
        angle: largest angle of a start, in degrees.
        shift: largest shift of a start, in the clouds' unit.
        max_distance: of corresponding points, in the clouds' unit.
        is_target_sampled: whether the target is sampled like the source; otherwise all of its
            points are used.
        seed: of all draws.
    """

    sizes: Sequence[int]
    methods: Sequence[Method]
    registrations: Sequence[str]
    draws: int
    motions: int
    angle: float
    shift: float
    max_distance: float
    is_target_sampled: bool
    seed: int


@dataclass(frozen=True)
class Score:
    """One method in one draw.

    Attributes:
        draw: its number.
        registration: its kind.
        m: number of points asked for; 0: all.
        method: its name.
        degrees: median error of the rotation.
        aligned: share of errors below ``ALIGNED``.
        shift: median error of the position of the source's mean, in the clouds' unit.
        points: mean number of points of a sample.
        sampling: median seconds of sampling a cloud, of processor time.
        aligning: median seconds of an alignment, of processor time.
        pairs: number of alignments.
    """

    draw: int
    registration: str
    m: int
    method: str
    degrees: float
    aligned: float
    shift: float
    points: float
    sampling: float
    aligning: float
    pairs: int


@dataclass(frozen=True)
class Sampled:
    """A pair of which the source, and perhaps the target, is sampled."""

    pair: Pair
    source: Sample
    target: Target


def compare_by_icp(pairs_of_draw: Callable[[int], list[Pair]], setup: Setup) -> Iterator[Score]:
    """Align all pairs of all draws from the samples of all methods.

    All methods of a draw see the same pairs and starts.

    Args:
        pairs_of_draw: returns the pairs of a draw by its number.
        setup: how.

    Raises:
        UserError: a size is out of range for a pair.
    """
    console = Console(stderr=True)
    draws = range(setup.draws)
    for draw in track(draws, "Draws", console=console, disable=not console.is_terminal):
        pairs = pairs_of_draw(draw)
        check_sizes(pairs, setup.sizes)
        seed = derive_seed(setup.seed, draw)
        starts = draw_motions(pairs, setup.motions, setup.angle, setup.shift, seed)
        whole = [prepare_target(pair.target) for pair in pairs]
        complete = []
        for pair, target in zip(pairs, whole, strict=True):
            complete.append(Sampled(pair, Sample(pair.source, 0.0), target))
        yield from _scores(complete, starts, setup, draw, 0, EVERYTHING)
        for m in setup.sizes:
            for method in setup.methods:
                if draw == 0:  # imports and compilation are in no method's time
                    first = pairs[0]
                    method.sample(first.source, m, seed, first.path)
                samples = []
                for pair, target in zip(pairs, whole, strict=True):
                    samples.append(_sampled(pair, target, method, m, seed, setup))
                yield from _scores(samples, starts, setup, draw, m, method.name)


def check_sizes(pairs: Sequence[Pair], sizes: Sequence[int]) -> None:
    """Reject sizes that a pair does not have, or that small_gicp refuses.

    Raises:
        UserError: a size is out of range.
    """
    for pair in pairs:
        most = min(len(pair.source), len(pair.target))
        for m in sizes:
            if not LEAST <= m <= most:
                raise UserError(
                    f"--m must be from {LEAST}, the fewest points that small_gicp aligns, to "
                    f"{most:,}, the points of a cloud of {pair.path}, got {m}."
                )


def _sampled(pair: Pair, whole: Target, method: Method, m: int, seed: int, setup: Setup) -> Sampled:
    source = method.sample(pair.source, m, seed, pair.path)
    if not setup.is_target_sampled:
        return Sampled(pair, source, whole)
    target = method.sample(pair.target, m, seed, pair.path)
    return Sampled(pair, source, prepare_target(target.points))


def _scores(
    samples: Sequence[Sampled],
    starts: Sequence[Sequence[Points]],
    setup: Setup,
    draw: int,
    m: int,
    method: str,
) -> Iterator[Score]:
    """Align the samples by every registration."""
    for registration in setup.registrations:
        errors: list[PoseError] = []
        for sample, poses in zip(samples, starts, strict=True):
            source = prepare_source(sample.source.points, registration)
            centre = sample.pair.source.mean(0)
            errors += [
                timed_error(
                    sample.target,
                    source,
                    start,
                    registration,
                    setup.max_distance,
                    truth=sample.pair.truth,
                    centre=centre,
                )
                for start in poses
            ]
        yield Score(
            draw,
            registration,
            m,
            method,
            degrees=median(error.degrees for error in errors),
            aligned=fmean(error.degrees < ALIGNED for error in errors),
            shift=median(error.shift for error in errors),
            points=fmean(len(sample.source.points) for sample in samples),
            sampling=median(sample.source.seconds for sample in samples),
            aligning=median(error.seconds for error in errors),
            pairs=len(errors),
        )
