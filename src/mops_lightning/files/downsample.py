"""Downsampling one file: read, normalise as in training, sample, map back, write."""

import filecmp
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.data.formats.cloud_file import PART
from mops_lightning.data.formats.guard import WholeOnlyError, check_coordinates, check_size
from mops_lightning.data.formats.registry import open_cloud_file, read, write
from mops_lightning.data.formats.table import Column, Table
from mops_lightning.errors import UserError
from mops_lightning.files.by_distance import keep_by_distance
from mops_lightning.files.chunks import Outcome, count_by_class, draw, sample_by_chunks
from mops_lightning.files.column_weights import weights_of
from mops_lightning.files.engine import Engine
from mops_lightning.files.features import channels_for, generated_columns
from mops_lightning.files.normal_columns import normals_of
from mops_lightning.files.options import Options
from mops_lightning.files.propagate import write_map
from mops_lightning.files.sample_cloud import Generated, Sampled, sample_cloud
from mops_lightning.files.space import in_space
from mops_lightning.ops.weights import check_positive
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.by_budget import ByBudget
from mops_lightning.samplers.by_normals import ByNormals
from mops_lightning.samplers.fps import farthest_rows
from mops_lightning.samplers.poisson import poisson_rows
from mops_lightning.samplers.strata import count_classes
from mops_lightning.zoo.find_sampler import untrained
from mops_lightning.zoo.load import load

SURFACE = 10_000
"""Least number of points that are sampled from a mesh."""


@cache
def load_sampler(options: Options, m: int | None = None) -> Sampler:
    """Load or build the sampler that the options name.

    Args:
        options: with a method or weights.
        m: number of points to keep of a file; None: ``options.m``, where that is a number.

    Raises:
        UserError: the weights are not a sampler's, or were trained for another number of points.
    """
    if m is None and isinstance(options.m, int):
        m = options.m
    sampler = _load(options, m)
    if options.weight is not None:
        try:
            sampler.check_weighted(options.readout)
        except UserError as error:
            raise UserError(f"--{error}") from None
    return sampler


def _load(options: Options, m: int | None) -> Sampler:
    torch.manual_seed(options.seed)
    if options.method:
        return untrained(options.method, m or 1, options.seed)
    assert options.weights is not None
    try:
        sampler = load(options.weights)
    except UserError as error:
        raise UserError(f"--weights: {error}") from None
    needs_sizes = options.tile is not None or options.strata is not None
    if needs_sizes or isinstance(options.m, float):
        _check_flexible(sampler, options)
    if not needs_sizes:
        _check_size(sampler, options, m)
    return sampler


def _check_flexible(sampler: Sampler, options: Options) -> None:
    if sampler.flexible:
        return
    reason = "a share needs"
    if options.strata is not None:
        reason = "classes need"
    if options.tile is not None:
        reason = "tiles need"
    raise UserError(
        f"--weights: {reason} a sampler of every size, such as FMOPS-Net; {options.weights} is a "
        f"{type(sampler).__name__} for {sampler.m} points."
    )


def _check_size(sampler: Sampler, options: Options, m: int | None) -> None:
    if options.m is None and isinstance(sampler, ByBudget):
        raise UserError(
            f"--m: {options.weights} holds the best method of every number of points. Give --m."
        )
    is_smaller = m is not None and m < sampler.m
    if m is None or m == sampler.m or (is_smaller and sampler.flexible):
        return
    allowed = f"{sampler.m}"
    advice = f"Give --m {sampler.m}, or train with m={m}"
    if sampler.flexible:
        allowed = f"up to {sampler.m}"
        advice = f"Give --m {sampler.m} or less, or train with sampler.m_max={m}"
    raise UserError(f"--m: {options.weights} was trained for {allowed} points, got {m}. {advice}.")


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
    engine = engine or Engine()
    if options.draws:
        table, outcome = _sample_drawn(source, options, engine)
    elif options.chunk is None:
        table, outcome = _sample_whole(source, options, engine)
    elif options.is_by_distance:
        table, outcome = keep_by_distance(source, None, options, engine)
    else:
        table, outcome = sample_by_chunks(source, load_sampler(options), options, engine)
    write(target, table)  # last, so that a file that exists is complete
    return outcome


def _sample_whole(source: Path, options: Options, engine: Engine) -> tuple[Table, Outcome]:
    """Read a file as a whole, keep a part of its points, and write their map."""
    surface = options.surface or _surface(options)
    whole = _read(source, surface, options)
    if options.is_by_distance:
        table, outcome = keep_by_distance(source, whole, options, engine)
    else:
        finite = whole.finite()
        number = len(finite.points)
        counts = None
        if options.strata is not None:
            classes = options.strata.classes(finite, source)
            counts = count_classes(classes)
        m = _number(options, number)
        table = _sample_table(source, finite, m, options, counts)
        outcome = Outcome(m, number, len(whole.points) - number)
    if options.map is not None:
        _write_map(options.map, whole, table, options)
    return table, outcome


def _read(source: Path, surface: int, options: Options) -> Table:
    return read(source, surface, options.seed, options.area, options.columns, options.vertices)


def _write_map(path: Path, whole: Table, kept: Table, options: Options) -> None:
    """Write the map, or keep an equal one of the same command that was killed before its output.

    Raises:
        UserError: there is another file.
    """
    k = min(options.map_k, len(kept.points))
    if options.overwrite or not path.exists():
        write_map(path, whole.points, kept.points, k)
        return
    with TemporaryDirectory() as folder:
        fresh = Path(folder) / path.name
        write_map(fresh, whole.points, kept.points, k)
        is_same = filecmp.cmp(fresh, path, shallow=False)
    if not is_same:
        raise UserError(f"{path} exists. Give another --map, or --overwrite.")


def count_points(source: Path, options: Options) -> int:
    """Return how many points a file has, of which ``options.m`` are to be kept."""
    try:
        file = open_cloud_file(source, options.area, options.columns)
    except WholeOnlyError:
        table = _read(source, options.surface or SURFACE, options)
        return len(table.finite().points)
    number = 0
    for rows in file.row_ranges(PART):
        number += len(file.read(rows).points)
    return number


def _surface(options: Options) -> int:
    """Return how many points to sample from a mesh."""
    if options.is_by_distance or isinstance(options.m, float):
        return SURFACE
    return max(SURFACE, 8 * _number(options, 0))


def _number(options: Options, points: int) -> int:
    """Return how many of a file's points to keep."""
    trained = 1
    if options.m is None:
        trained = load_sampler(options).m
    return options.number(trained, points)


def _sample_drawn(source: Path, options: Options, engine: Engine) -> tuple[Table, Outcome]:
    """Draw random points of a file, and sample these."""
    assert options.chunk is not None
    counts = None
    quotas = None
    if options.strata is not None:
        counts = count_by_class(source, options, engine)
        total = sum(counts.values())
        m = _number(options, total)
        options.check_chunk(m)
        check_size(source, total, m, options.area)
        quotas = options.strata.numbers(counts, min(options.chunk, total))
        for name, number in options.strata.numbers(counts, m).items():
            quotas[name] = max(quotas[name], number)
    drawn, number, dropped = draw(source, options, engine, quotas)
    m = _number(options, number)
    options.check_chunk(m)
    table = _sample_table(source, drawn, m, options, counts)
    return table, Outcome(m, number, dropped, len(drawn.points))


def _sample_table(
    source: Path,
    finite: Table,
    m: int,
    options: Options,
    counts: Mapping[int, int] | None,
) -> Table:
    """Sample the finite points of a file, or some of them; without those of weight 0.

    Args:
        source: the file.
        finite: the points.
        m: number of points to keep.
        options: how.
        counts: number of points of every class in the file; None: classes do not matter.
    """
    check_size(source, len(finite.points), m, options.area)
    channels = None
    if options.weights is not None:
        sampler = load_sampler(options)
        channels = channels_for(finite, sampler.point_channels, source)
    if options.strata is None or counts is None:
        rows, generated = _rows(source, finite, m, options, channels)
        if rows is None:
            assert generated is not None
            return _generated_table(finite, generated, options)
        return _kept(finite, rows, options)
    classes = options.strata.classes(finite, source)
    by_class = []
    for name, number in options.strata.numbers(counts, m).items():
        if number:
            members = np.flatnonzero(classes == name)
            of_members = _rows_of_channels(channels, members)
            chosen, _ = _rows(source, finite.take(members), number, options, of_members)
            assert chosen is not None  # classes keep input points
            by_class.append(members[chosen])
    kept = np.concatenate(by_class)
    return _kept(finite, np.sort(kept), options)


def _rows_of_channels(channels: Tensor | None, rows: NDArray[np.int64]) -> Tensor | None:
    if channels is None:
        return None
    return channels[torch.from_numpy(rows)]


def _generated_table(table: Table, generated: Generated, options: Options) -> Table:
    columns: Mapping[str, Column] = {}
    if generated.channels is not None and not options.coordinates_only:
        channels = load_sampler(options).point_channels
        columns = generated_columns(table, channels, generated.channels)
    return Table(generated.points, columns, table.header)


def _kept(table: Table, rows: NDArray[np.int64], options: Options) -> Table:
    kept = table.take(rows)
    if options.coordinates_only:
        return kept.without_attributes()
    return kept


def _rows(
    source: Path, finite: Table, m: int, options: Options, channels: Tensor | None
) -> Sampled:
    """Return the rows of the points that are kept, or generated points."""
    if options.weight is None:
        return _rows_of_weighted(source, finite, m, options, channels, None)
    weight = weights_of(finite, options.weight, source)
    heavy = np.flatnonzero(weight)
    check_positive(len(heavy), m, f"--weight {options.weight} of {source}")
    of_heavy = _rows_of_channels(channels, heavy)
    rows, generated = _rows_of_weighted(
        source, finite.take(heavy), m, options, of_heavy, weight[heavy]
    )
    if rows is not None:
        rows = heavy[rows]
    return rows, generated


def _rows_of_weighted(
    source: Path,
    table: Table,
    m: int,
    options: Options,
    channels: Tensor | None,
    weight: NDArray[np.float64] | None,
) -> Sampled:
    if options.space is not None:
        return _rows_in_space(table, m, options, source, weight), None
    sampler = load_sampler(options, m)
    normals = None
    if isinstance(sampler, ByNormals):
        normals = normals_of(table)
    return sample_cloud(table.points, sampler, m, options, source, weight, channels, normals)


def _rows_in_space(
    table: Table,
    m: int,
    options: Options,
    source: Path,
    weight: NDArray[np.float64] | None,
) -> NDArray[np.int64]:
    """Choose farthest points, or those of sample elimination, by the columns that count."""
    used = in_space(table, options.space, source)
    check_coordinates(source, used)
    weights = None
    if weight is not None:
        weights = torch.from_numpy(weight)[None]
    clouds = torch.from_numpy(used)[None]
    if options.method == "poisson":
        rows = poisson_rows(clouds, m, options.seed, weights, in_sphere=True)
    else:
        rows = farthest_rows(clouds, m, options.seed, weight=weights, in_sphere=True)
    return rows[0].numpy()
