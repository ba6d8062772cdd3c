"""Downsampling one file: read, normalise as in training, sample, map back, write."""

from functools import cache
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from mops_lightning.data.formats.errors import check_size
from mops_lightning.data.formats.registry import read, write
from mops_lightning.data.formats.table import Table
from mops_lightning.downsample_files.large import Engine, Kept, by_chunks, in_turn
from mops_lightning.downsample_files.scene import sample_scene
from mops_lightning.downsample_files.seams import Seams
from mops_lightning.downsample_files.settings import Settings
from mops_lightning.downsample_files.unit_sphere import largest_distance, sum_of, unit_sphere
from mops_lightning.errors import UserError
from mops_lightning.ops.readout import complete
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.samplers.streaming import stream_match, stream_sample
from mops_lightning.zoo.load import load
from mops_lightning.zoo.methods import untrained

CHUNK = 65536
"""Number of points that a learned sampler processes at a time; it bounds the memory of features."""


ANY_SIZE = 2**31 - 1
"""The largest sample of an untrained method that is asked for a ratio."""


class Outcome(NamedTuple):
    """What became of a file.

    Attributes:
        written: number of points that were written.
        number: how many points with finite coordinates the cloud has.
        dropped: how many it has without.
        seams: close pairs at the seams of tiles.
    """

    written: int
    number: int
    dropped: int
    seams: Seams | None = None


@cache
def sampler_of(settings: Settings) -> Sampler:
    """Build the sampler that the settings name.

    Raises:
        UserError: the weights are not a sampler's, or were trained for another number of points.
    """
    torch.manual_seed(settings.seed)
    if settings.method:
        return untrained(settings.method, settings.m or ANY_SIZE, settings.seed)
    assert settings.weights is not None
    try:
        sampler = load(settings.weights)
    except UserError as error:
        raise UserError(f"--weights: {error}") from None
    if settings.tiled and not sampler.flexible:
        raise UserError(
            f"--weights: tiles need a sampler of every size, such as FMOPS-Net; "
            f"{settings.weights} is a {type(sampler).__name__} for {sampler.m} points."
        )
    m = None if settings.tiled else settings.m  # a tile keeps a part of them
    if m is not None and (m > sampler.m or (m != sampler.m and not sampler.flexible)):
        allowed = f"up to {sampler.m}" if sampler.flexible else f"{sampler.m}"
        raise UserError(
            f"--m: {settings.weights} was trained for {allowed} points, got {m}. "
            f"Give --m {sampler.m}{' or less' * sampler.flexible}, or train with m={m}."
        )
    return sampler


def run(source: Path, target: Path, settings: Settings, engine: Engine = in_turn) -> Outcome:
    """Downsample one file into another.

    Raises:
        UserError: the file holds no cloud, or one of too few points.
    """
    sampler = sampler_of(settings)
    m = settings.m or sampler.m
    if settings.tiled:
        kept = sample_scene(source, target, sampler, settings, engine)
    elif settings.chunk:
        kept = by_chunks(
            source, sampler, m, settings.chunk, settings.readout, settings.keep_attributes, engine
        )
    else:
        table = read(source, settings.surface or max(10_000, 8 * m), settings.seed)
        finite = table.finite()
        number = len(finite.points)
        check_size(source, number, m)
        chosen = sampled(source, finite, sampler, m, settings)
        kept = Kept(chosen, number, len(table.points) - number)
    write(target, kept.table)
    return Outcome(len(kept.table.points), kept.number, kept.dropped, kept.seams)


def sampled(source: Path, table: Table, sampler: Sampler, m: int, settings: Settings) -> Table:
    """Return the sampled points of a table, with their attributes if ``keep_attributes``."""
    centre = sum_of(table.points) / len(table.points)
    sphere = unit_sphere(centre, largest_distance(table.points, centre), source)
    points = sphere.normalise(table.points)
    with torch.no_grad():
        rows, generated = _chosen(points, sampler, m, settings)
    if rows is None:
        return Table(sphere.restore(generated), {}, table.header)
    kept = table.take(rows.numpy())
    return kept if settings.keep_attributes else kept.without_attributes()


def _chosen(
    points: Tensor, sampler: Sampler, m: int, settings: Settings
) -> tuple[Tensor | None, Tensor]:
    """Return the rows ``(m,)`` of the points to keep, or None, and the generated points."""
    if isinstance(sampler, MOPSNet) and sampler.streams:
        generated = stream_sample(sampler, lambda: list(points.split(CHUNK)), m)
    else:
        output = sampler(points[None], m)
        generated = output.points[0]
        if not sampler.generates:
            return output.indices[0], generated
    if settings.readout == "generated":
        return None, generated
    rows = stream_match(generated, lambda: list(points.split(CHUNK)))
    if settings.readout == "completed":
        rows = complete(rows[None], points[None])[0]
    return rows, generated
