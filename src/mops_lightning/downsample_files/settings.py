"""What to do with every file, as the command line says it."""

import math
from dataclasses import dataclass

from mops_lightning.errors import UserError
from mops_lightning.records.readout_names import GENERATED_READOUTS

METHODS = ("fps", "random", "voxel", "poisson")
"""Untrained samplers."""


@dataclass(frozen=True)
class Settings:
    """What to do with every file.

    Attributes:
        m: number of points to keep; None: as many as the weights were trained for.
        weights: of a trained sampler: a model, a weights file, or the folder of its run.
        method: one of ``METHODS``, instead of weights.
        readout: of a trained sampler: generated, matched or completed.
        keep_attributes: keep colours, normals and the like of the kept points.
        surface: number of points to sample from a mesh's surface first.
        seed: of random choices.
        chunk: number of points to read at a time; None: the whole file.
        tile: most points of a tile; None: no tiles of a number of points.
        tile_size: side of cubic tiles in the file's own unit; None: no cubic tiles.
        ratio: share of the points to keep, instead of m; with tiles only.

    Raises:
        UserError: a value is out of range, or options exclude each other.
    """

    m: int | None
    weights: str | None = None
    method: str | None = None
    readout: str = "completed"
    keep_attributes: bool = False
    surface: int | None = None
    seed: int = 0
    chunk: int | None = None
    tile: int | None = None
    tile_size: float | None = None
    ratio: float | None = None

    @property
    def tiled(self) -> bool:
        """Whether clouds are cut into tiles."""
        return self.tile is not None or self.tile_size is not None

    def __post_init__(self) -> None:
        """Reject values out of range and options that exclude each other."""
        if (self.weights is None) == (self.method is None):
            raise UserError(
                "give either --weights MODEL of a trained sampler or --method "
                f"{'|'.join(METHODS)}, not both."
            )
        self._check_tiles()
        needed = self.method and self.ratio is None
        if (self.m is not None and self.m < 1) or (self.m is None and needed):
            raise UserError(f"--m must be a whole number of at least 1, got {self.m}.")
        if self.chunk is not None and self.chunk < 1:
            raise UserError(f"--chunk must be at least 1, got {self.chunk}.")
        whole = self.method or self.readout == "completed"
        if self.chunk is not None and whole and not self.tiled:
            raise UserError(
                "--chunk needs --weights of MOPS-Net and --readout generated or matched, or tiles "
                "(--tile, --tile-size): everything else needs the whole cloud at once."
            )
        if self.surface is not None and self.surface < 1:
            raise UserError(f"--surface must be at least 1, got {self.surface}.")
        if self.readout not in GENERATED_READOUTS:
            raise UserError(
                f"--readout must be one of {', '.join(GENERATED_READOUTS)}, got {self.readout}."
            )
        if self.keep_attributes and self.weights and self.readout == "generated":
            raise UserError(
                "--keep-attributes: generated points are new and have no attributes. Use "
                "--readout completed or matched."
            )

    def _check_tiles(self) -> None:
        """Reject tiles and ratios out of range, or with options that they exclude."""
        if self.tile is not None and self.tile_size is not None:
            raise UserError("give either --tile POINTS or --tile-size SIDE, not both.")
        if self.tile is not None and self.tile < 2:
            raise UserError(f"--tile must be at least 2, got {self.tile}.")
        if self.tile_size is not None and not 0 < self.tile_size < math.inf:
            raise UserError(f"--tile-size must be above 0 and finite, got {self.tile_size}.")
        if self.ratio is not None and not 0 < self.ratio <= 1:
            raise UserError(f"--ratio must be above 0 and at most 1, got {self.ratio}.")
        if self.ratio is not None and (self.m is not None or not self.tiled):
            raise UserError("--ratio replaces --m, with --tile or --tile-size only.")
        if self.tiled and self.m is None and self.ratio is None:
            raise UserError("--tile and --tile-size need --m or --ratio.")
        if self.tiled and self.readout != "completed":
            raise UserError(f"--tile keeps different input points: no --readout {self.readout}.")
        if self.tile is not None and self.chunk is not None and self.chunk < self.tile:
            raise UserError(f"--chunk must be at least --tile {self.tile}, got {self.chunk}.")
