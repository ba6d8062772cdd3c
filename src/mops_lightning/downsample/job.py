"""One file: read, normalised as in training, sampled, mapped back, written."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mops_lightning.downsample.formats.errors import check_size
from mops_lightning.downsample.formats.registry import read, write
from mops_lightning.downsample.formats.table import Table
from mops_lightning.downsample.large import Engine, Kept, by_chunks, in_turn
from mops_lightning.downsample.unit_sphere import largest_distance, sum_of, unit_sphere
from mops_lightning.errors import UserError
from mops_lightning.ops.readout import complete
from mops_lightning.records.readout_names import GENERATED_READOUTS
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.samplers.poisson import PoissonSampler
from mops_lightning.samplers.random import RandomSampler
from mops_lightning.samplers.streaming import stream_match, stream_sample
from mops_lightning.samplers.voxel import VoxelSampler
from mops_lightning.zoo.load import load

CHUNK = 65536
"""Points that a learned sampler sees at a time; it bounds the memory that its features take."""

METHODS = ("fps", "random", "voxel", "poisson")


@dataclass(frozen=True)
class Settings:
    """What to do with every file.

    Attributes:
        m: points to keep; None: as many as the weights were trained for.
        weights: of a learned sampler: a weights file, or the folder of its run.
        method: one of ``METHODS``, in place of weights.
        readout: of a learned sampler: generated, matched or completed.
        keep_attributes: keep colours, normals and the like of the kept points.
        surface: points to sample from a mesh's surface first.
        seed: of what is random.
        chunk: read so many points at a time; None: the whole file.
    """

    m: int | None
    weights: Path | None = None
    method: str | None = None
    readout: str = "completed"
    keep_attributes: bool = False
    surface: int | None = None
    seed: int = 0
    chunk: int | None = None

    def __post_init__(self) -> None:
        """Refuse what does not go together."""
        if (self.weights is None) == (self.method is None):
            raise UserError(
                "give --weights FILE of a trained sampler or --method "
                f"{'|'.join(METHODS)}, and not both."
            )
        if (self.m is not None and self.m < 1) or (self.m is None and self.method):
            raise UserError(f"--m must be a whole number of at least 1, got {self.m}.")
        whole = self.method or self.readout == "completed"
        if self.chunk is not None and self.chunk < 1:
            raise UserError(f"--chunk must be at least 1, got {self.chunk}.")
        if self.chunk is not None and whole:
            raise UserError(
                "--chunk goes with --weights of MOPS-Net and --readout "
                "generated or matched: everything else needs the whole cloud at once."
            )
        if self.surface is not None and self.surface < 1:
            raise UserError(f"--surface must be at least 1, got {self.surface}.")
        if self.readout not in GENERATED_READOUTS:
            raise UserError(f"--readout must be one of {', '.join(GENERATED_READOUTS)}.")
        if self.keep_attributes and self.weights and self.readout == "generated":
            raise UserError(
                "--keep-attributes: generated points are new and have none. Take "
                "--readout completed or matched."
            )


@cache
def sampler_of(settings: Settings) -> Sampler:
    """Build the sampler that the settings name.

    Raises:
        UserError: the weights are not a sampler's, or were trained for another number of points.
    """
    torch.manual_seed(settings.seed)
    if settings.method:
        classes: Any = {
            "fps": FPSSampler,
            "random": RandomSampler,
            "voxel": VoxelSampler,
            "poisson": PoissonSampler,
        }
        own = {} if settings.method == "voxel" else {"seed": settings.seed}
        return classes[settings.method](settings.m, **own)
    assert settings.weights is not None
    sampler = load(settings.weights)
    m = settings.m
    if m is not None and (m > sampler.m or (m != sampler.m and not sampler.flexible)):
        allowed = f"up to {sampler.m}" if sampler.flexible else f"{sampler.m}"
        raise UserError(
            f"--m: {settings.weights} was trained for {allowed} points, got {m}. "
            f"Leave --m out, or train with m={m}."
        )
    return sampler


def run(
    source: Path, target: Path, settings: Settings, engine: Engine = in_turn
) -> tuple[int, int, int]:
    """Downsample one file into another.

    Returns:
        How many points were written, how many points with finite coordinates the cloud has, and how
        many without.

    Raises:
        UserError: the file holds no cloud, or one of too few points.
    """
    sampler = sampler_of(settings)
    m = settings.m or sampler.m
    if settings.chunk:
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
    return len(kept.table.points), kept.number, kept.dropped


def sampled(source: Path, table: Table, sampler: Sampler, m: int, settings: Settings) -> Table:
    """Return the sampled points of a table, with their attributes if ``keep_attributes``."""
    centre = sum_of(table.points) / len(table.points)
    sphere = unit_sphere(centre, largest_distance(table.points, centre), source)
    with torch.no_grad():
        rows, generated = _chosen(sphere.normalize(table.points), sampler, m, settings)
    if rows is None:
        return Table(sphere.restore(generated), {}, table.header)
    kept = table.take(rows.numpy())
    return kept if settings.keep_attributes else kept.without_attributes()


def _chosen(
    points: Tensor, sampler: Sampler, m: int, settings: Settings
) -> tuple[Tensor | None, Tensor]:
    """Return the rows of the points to keep, or None and the generated points."""

    def chunks() -> list[Tensor]:
        return list(points.split(CHUNK))

    if isinstance(sampler, MOPSNet):
        generated = stream_sample(sampler, chunks, m)
    else:
        output = sampler(points[None], m)
        generated = output.points[0]
        if not sampler.generates:
            return output.indices[0], generated
    if settings.readout == "generated":
        return None, generated
    rows = stream_match(generated, chunks)
    return (complete(rows[None], points[None])[0] if settings.readout == "completed" else rows), (
        generated
    )
