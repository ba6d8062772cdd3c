"""One file: read, normalised as in training, sampled, mapped back, written."""

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.data.mesh_io import parse_mesh
from mops_lightning.downsample.formats.registry import READABLE, READERS, WRITERS
from mops_lightning.downsample.formats.table import (
    BadCloudError,
    Table,
    check_enough,
    naming,
    radius_of,
    reach,
    total,
)
from mops_lightning.downsample.large import Engine, by_chunks, in_turn
from mops_lightning.errors import UserError
from mops_lightning.files import atomic_write
from mops_lightning.ops.readout import complete
from mops_lightning.records.readout_names import GENERATED_READOUTS
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.samplers.poisson import PoissonSampler
from mops_lightning.samplers.random import RandomSampler
from mops_lightning.samplers.streaming import stream_match, stream_sample
from mops_lightning.samplers.voxel import VoxelSampler
from mops_lightning.zoo import weights

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
        UserError: the weights are no sampler's, or were trained for another number of points.
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
    path = settings.weights.expanduser()
    path = weights.of_run(path) if path.is_dir() else path
    if not path.is_file():
        raise UserError(f"--weights: no file {path}. Give a weights.pt, or the folder of its run.")
    content = weights.load(path)
    if content["config"]["learn"] == "task":
        raise UserError(f"--weights: {path} holds a task net; give a sampler's run.")
    from omegaconf import OmegaConf

    from mops_lightning.config.build import build

    sampler: Sampler = build(OmegaConf.create(content["config"]["sampler"]))
    weights.fit_state(sampler, content["state"], path)
    m = settings.m
    if m is not None and (m > sampler.m or (m != sampler.m and not sampler.flexible)):
        allowed = f"up to {sampler.m}" if sampler.flexible else f"{sampler.m}"
        raise UserError(
            f"--m: {path} was trained for {allowed} points, got {m}. Leave --m out, or train "
            f"with m={m}."
        )
    return sampler.eval()


def run(
    source: Path, target: Path, settings: Settings, engine: Engine = in_turn
) -> tuple[int, int, int]:
    """Downsample one file into another.

    Returns:
        How many points were written, how many the cloud had, and how many more were left out for
        not being finite.

    Raises:
        UserError: the file holds no cloud, or too small a one.
    """
    sampler = sampler_of(settings)
    m = settings.m or sampler.m
    if settings.chunk:
        kept, number, dropped = by_chunks(
            source, sampler, m, settings.chunk, settings.readout, settings.keep_attributes, engine
        )
        _write(target, kept)
        return len(kept.points), number, dropped
    table = read(source, settings.surface or max(10_000, 8 * m), settings.seed)
    finite = table.finite()
    number = len(finite.points)
    check_enough(source, number, m)
    kept = sampled(source, finite, sampler, m, settings)
    _write(target, kept)
    return len(kept.points), number, len(table.points) - number


def _write(target: Path, table: Table) -> None:
    with atomic_write(target) as temporary:
        WRITERS[target.suffix.lower()](temporary, table)


def read(path: Path, surface: int, seed: int) -> Table:
    """Read a cloud, or sample ``surface`` points from a mesh.

    Raises:
        UserError: naming the file and what is wrong with it.
    """
    suffix = path.suffix.lower()
    if suffix not in READABLE:
        raise BadCloudError(f"{path} must end in {', '.join(READABLE)}.")
    if not path.is_file():
        raise BadCloudError(f"{path}: no such file.")
    with naming(path):
        table = READERS[suffix](path) if suffix in READERS else None
        data = path.read_bytes() if table is None else b""
    if table is not None:
        return table
    if suffix == ".obj" and not re.search(rb"^f\s", data, re.M):
        words = [line.split()[1:4] for line in data.splitlines() if line[:2] in (b"v ", b"v\t")]
        if not words:
            raise BadCloudError(f"{path} holds no vertices.")
        return Table(np.array(words, np.float64))
    mesh = parse_mesh(data, path)
    points, faces = trimesh.sample.sample_surface(mesh, surface, seed=seed)
    normals = np.asarray(mesh.face_normals)[faces].T
    columns = dict(zip(("nx", "ny", "nz"), normals.astype(np.float32), strict=True))
    return Table(np.asarray(points, np.float64), columns)


def sampled(source: Path, table: Table, sampler: Sampler, m: int, settings: Settings) -> Table:
    """Return the kept points of a table, with their attributes if asked for."""
    centre = total(table.points) / len(table.points)
    radius = radius_of(reach(table.points, centre), source)
    points = torch.from_numpy(((table.points - centre) / radius).astype(np.float32))
    with torch.no_grad():
        rows, generated = _chosen(points, sampler, m, settings)
    if rows is None:
        made: NDArray[np.float64] = generated.double().numpy() * radius + centre
        return Table(made, {}, table.head)
    kept = table.take(rows.numpy())
    return kept if settings.keep_attributes else kept.bare()


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
