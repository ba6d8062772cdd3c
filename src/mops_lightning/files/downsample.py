"""Downsampling one file: read, normalise as in training, sample, map back, write."""

from functools import cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import expit

from mops_lightning.data.formats.guard import BadCloudError, check_coordinates, check_size
from mops_lightning.data.formats.registry import read, write
from mops_lightning.data.formats.table import Table
from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.files.chunks import Outcome, draw, sample_by_chunks
from mops_lightning.files.engine import Engine
from mops_lightning.files.options import Options
from mops_lightning.files.propagate import write_map
from mops_lightning.ops.points import UnitSphere
from mops_lightning.ops.weights import CURVATURE, check_positive, check_weight, curvature
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.tiles import sample_by_tiles
from mops_lightning.zoo.find_sampler import untrained
from mops_lightning.zoo.load import load

SURFACE = 10_000
"""Least number of points that are sampled from a mesh."""

SPLAT = {"opacity", "f_dc_0", "scale_0", "rot_0"}
"""Columns of a splat file (Kerbl et al., "3D Gaussian Splatting", SIGGRAPH 2023)."""


@cache
def load_sampler(options: Options) -> Sampler:
    """Load or build the sampler that the options name.

    Raises:
        UserError: the weights are not a sampler's, or were trained for another number of points.
    """
    sampler = _load(options)
    if options.weight is not None:
        try:
            sampler.check_weighted(options.readout)
        except UserError as error:
            raise UserError(f"--{error}") from None
    return sampler


def _load(options: Options) -> Sampler:
    torch.manual_seed(options.seed)
    if options.method:
        assert options.m is not None
        return untrained(options.method, options.m, options.seed)
    assert options.weights is not None
    try:
        sampler = load(options.weights)
    except UserError as error:
        raise UserError(f"--weights: {error}") from None
    if options.tile is not None:
        if not sampler.flexible:
            raise UserError(
                f"--weights: tiles need a sampler of every size, such as FMOPS-Net; "
                f"{options.weights} is a {type(sampler).__name__} for {sampler.m} points."
            )
        return sampler  # a tile keeps a part of the m points
    m = sampler.m if options.m is None else options.m
    if m > sampler.m or (m != sampler.m and not sampler.flexible):
        allowed = f"up to {sampler.m}" if sampler.flexible else f"{sampler.m}"
        raise UserError(
            f"--m: {options.weights} was trained for {allowed} points, got {m}. "
            f"Give --m {sampler.m}{' or less' * sampler.flexible}, or train with m={m}."
        )
    return sampler


def downsample_file(
    source: Path, target: Path, options: Options, engine: Engine | None = None
) -> Outcome:
    """Downsample one file into another.

    Args:
        source: the file.
        target: the file to write.
        options: how.
        engine: processes the chunks of a file; None: this process.

    Raises:
        UserError: the file holds no cloud, or one of too few points.
    """
    sampler = load_sampler(options)
    m = options.m or sampler.m
    engine = engine or Engine()
    if options.draws:
        drawn, number, dropped = draw(source, options, engine)
        table = _sample_table(source, drawn, sampler, m, options)
        outcome = Outcome(m, number, dropped)
    elif options.chunk is not None:
        table, outcome = sample_by_chunks(source, sampler, m, options, engine)
    else:
        surface = options.surface or max(SURFACE, 8 * m)
        whole = read(source, surface, options.seed, options.area, options.columns, options.vertices)
        finite = whole.finite()
        table, number = _sample_table(source, finite, sampler, m, options), len(finite.points)
        outcome = Outcome(m, number, len(whole.points) - number)
        if options.map is not None:
            write_map(options.map, whole.points, table.points, options.map_k)
    write(target, table)  # last, so that a file that exists is complete
    return outcome


def _sample_table(source: Path, finite: Table, sampler: Sampler, m: int, options: Options) -> Table:
    """Sample the finite points of a file, or some of them; without those of weight 0."""
    check_size(source, len(finite.points), m, options.area)
    weight = None
    if options.weight is not None:
        weight = weights_of(finite, options.weight, source)
        check_positive(int((weight > 0).sum()), m, f"--weight {options.weight} of {source}")
        finite, weight = finite.take(weight.nonzero()[0]), weight[weight > 0]
    rows, points = sample_cloud(finite.points, sampler, m, options, source, weight)
    if rows is None:
        return Table(points, {}, finite.header)
    kept = finite.take(rows)
    return kept.without_attributes() if options.coordinates_only else kept


def weights_of(table: Table, field: str, source: Path) -> NDArray[np.float64]:
    """Return one number of at least 0 per point.

    Args:
        table: of finite points.
        field: a column, or ``curvature``. Splat files hold the logit of the opacity; its weight is
            the opacity itself.
        source: the file, for errors.

    Raises:
        UserError: there is no such column, or it holds numbers that are no weights.
    """
    values = table.columns.get(field)
    if values is None and field == CURVATURE:
        return curvature(table.points)
    if values is None:
        hint = did_you_mean(field, {*table.columns, CURVATURE})
        raise BadCloudError(f"--weight: {source} has no column {field!r}.{hint}")
    values = values.astype(np.float64)
    if field == "opacity" and table.columns.keys() >= SPLAT:
        values = expit(values)
    name = f"--weight {field} of {source}"
    weight: NDArray[np.float64] = check_weight(values, values.shape, name).numpy()
    return weight


def sample_cloud(
    points: NDArray[np.float64],
    sampler: Sampler,
    m: int,
    options: Options,
    source: Path,
    weight: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.int64] | None, NDArray[np.float64]]:
    """Sample a cloud in the file's own unit.

    Args:
        points: ``(N, 3)`` finite, N ≥ m.
        sampler: from ``load_sampler``.
        m: number of points to keep.
        options: how.
        source: the file, for errors.
        weight: ``(N,)`` above 0; None: all points are equal.

    Returns:
        The rows ``(m,)`` of the kept points, or None for generated points; the points ``(m, 3)``.

    Raises:
        UserError: the coordinates are too large, or tiles keep more points than the sampler can.
    """
    check_coordinates(source, points)
    if options.tile is not None:
        rows = sample_by_tiles(points, options.tile, m, sampler)
        return rows, points[rows]
    sphere = UnitSphere.around(points)
    weights = None if weight is None else torch.from_numpy(weight)[None]
    new, found = sampler.select(options.readout, sphere.normalise(points)[None], m, weights)
    if found is None:
        return None, sphere.restore(new[0])
    rows = found[0].numpy()
    return rows, points[rows]
