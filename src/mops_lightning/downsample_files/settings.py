"""What to do with every file, as the command line says it."""

from dataclasses import dataclass
from pathlib import Path

from mops_lightning.errors import UserError
from mops_lightning.records.readout_names import GENERATED_READOUTS

METHODS = ("fps", "random", "voxel", "poisson")
"""Untrained samplers."""


@dataclass(frozen=True)
class Settings:
    """What to do with every file.

    Attributes:
        m: number of points to keep; None: as many as the weights were trained for.
        weights: of a trained sampler: a weights file, or the folder of its run.
        method: one of ``METHODS``, instead of weights.
        readout: of a trained sampler: generated, matched or completed.
        keep_attributes: keep colours, normals and the like of the kept points.
        surface: number of points to sample from a mesh's surface first.
        seed: of random choices.
        chunk: number of points to read at a time; None: the whole file.
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
        """Reject values out of range and options that exclude each other."""
        if (self.weights is None) == (self.method is None):
            raise UserError(
                "give either --weights FILE of a trained sampler or --method "
                f"{'|'.join(METHODS)}, not both."
            )
        if (self.m is not None and self.m < 1) or (self.m is None and self.method):
            raise UserError(f"--m must be a whole number of at least 1, got {self.m}.")
        if self.chunk is not None and self.chunk < 1:
            raise UserError(f"--chunk must be at least 1, got {self.chunk}.")
        if self.chunk is not None and (self.method or self.readout == "completed"):
            raise UserError(
                "--chunk needs --weights of MOPS-Net and --readout generated or matched: "
                "everything else needs the whole cloud at once."
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
