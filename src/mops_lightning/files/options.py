"""Options of ``downsample``, checked."""

from dataclasses import dataclass
from pathlib import Path

from mops_lightning.data.formats.area import Area
from mops_lightning.errors import UserError
from mops_lightning.zoo.names import UNTRAINED


@dataclass(frozen=True)
class Options:
    """Options of downsampling a file.

    Attributes:
        m: number of points to keep; None: as many as the weights were trained for.
        weights: of a trained sampler: a model, a weights file, or the folder of its run.
        method: one of ``zoo.names.UNTRAINED``, instead of weights.
        readout: of a trained sampler: generated, matched or completed.
        coordinates_only: leave out colours, normals and the like of the kept points.
        surface: number of points to sample from a mesh's surface first.
        seed: of random choices.
        chunk: number of points in memory; see ``draws``. None: the whole file.
        tile: most points of a tile; None: no tiles.
        map: file to write for ``mops_lightning.propagate``; None: no file.
        map_k: number of sampled points per point in this file.
        weight: a column with a weight per point, or ``curvature``; None: all points are equal.
        area: the part of the file to sample; None: all of it.
        columns: names of the columns of .bin files; None: those that their names imply.
        vertices: take the vertices of a mesh, instead of points on its surface.

    Raises:
        UserError: a value is out of range, or options exclude each other.
    """

    m: int | None
    weights: str | None = None
    method: str | None = None
    readout: str = "completed"
    coordinates_only: bool = False
    surface: int | None = None
    seed: int = 0
    chunk: int | None = None
    tile: int | None = None
    map: Path | None = None
    map_k: int = 1
    weight: str | None = None
    area: Area | None = None
    columns: tuple[str, ...] | None = None
    vertices: bool = False

    def __post_init__(self) -> None:
        """Reject values out of range and options that exclude each other."""
        if self.weights is None and self.method is None:
            raise UserError(f"give --method {'|'.join(UNTRAINED)}, or --weights MODEL.")
        if self.weights is not None and self.method is not None:
            raise UserError(f"give --weights or --method {self.method}, not both.")
        if (self.m is not None and self.m < 1) or (self.m is None and self.method):
            raise UserError(f"--m must be a whole number of at least 1, got {self.m}.")
        if self.surface is not None and self.surface < 1:
            raise UserError(f"--surface must be at least 1, got {self.surface}.")
        if self.vertices and self.surface is not None:
            raise UserError("--vertices takes the vertices of a mesh: leave --surface out.")
        if not 0 <= self.seed < 2**63:
            raise UserError(f"--seed must be from 0 to 2**63 - 1, got {self.seed}.")
        if self.map is not None and self.map.suffix.lower() != ".npz":
            raise UserError(f"--map must end in .npz, got {self.map}.")
        if self.map_k < 1 or (self.m is not None and self.map_k > self.m):
            raise UserError(f"--map-k must be from 1 to --m, got {self.map_k}.")
        if self.map is None and self.map_k != 1:
            raise UserError(f"--map-k {self.map_k} has no effect without --map FILE.npz.")
        self._check_parts()

    def _check_parts(self) -> None:
        """Reject tiles and chunks out of range, or with options that they exclude."""
        if self.tile is not None and self.tile < 2:
            raise UserError(f"--tile must be at least 2, got {self.tile}.")
        if self.tile is not None and self.m is None:
            raise UserError("--tile needs --m, the number of points to keep of all tiles together.")
        if self.tile is not None and self.readout != "completed":
            raise UserError(f"--tile keeps different input points: no --readout {self.readout}.")
        if self.weight is not None and self.tile is not None:
            raise UserError("--weight needs the whole cloud at once: leave --tile out.")
        if self.chunk is not None and self.map is not None:
            raise UserError("--map needs the whole cloud in memory: use propagate after --chunk.")
        if self.area is not None and self.map is not None:
            raise UserError("--map has a row for every point of IN: no --bounds or level with it.")
        if self.chunk is not None and self.chunk < 1:
            raise UserError(f"--chunk must be at least 1, got {self.chunk}.")
        if self.draws and self.m is not None and self.m > (self.chunk or 0):
            raise UserError(f"--chunk must be at least --m {self.m}, got {self.chunk}.")

    @property
    def draws(self) -> bool:
        """Whether ``chunk`` random points of a file are drawn first, and sampled."""
        streams = self.weights is not None and self.readout != "completed"
        return self.chunk is not None and not streams
