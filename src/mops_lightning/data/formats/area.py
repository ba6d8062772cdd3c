"""The part of a file to read: a box, and levels of detail of a COPC file."""

from contextlib import suppress
from dataclasses import dataclass
from math import inf
from pathlib import Path

import numpy as np

from mops_lightning.data.formats.guard import BadCloudError
from mops_lightning.data.formats.table import Table
from mops_lightning.errors import UserError


@dataclass(frozen=True)
class Area:
    """The part of a file to read: a box, and how deep to go into the octree of a COPC file.

    Attributes:
        low: lowest x, y and z; -inf for no limit.
        high: highest x, y and z, which belong to the box.
        level: deepest level of the octree, 0 for its root; None: all levels.
        resolution: distance of neighbouring points, in the file's unit, at which to stop; None: all
            levels.

    Raises:
        UserError: a value is out of range.
    """

    low: tuple[float, ...] = (-inf,) * 3
    high: tuple[float, ...] = (inf,) * 3
    level: int | None = None
    resolution: float | None = None

    def __post_init__(self) -> None:
        """Reject values out of range."""
        if self.level is not None and self.resolution is not None:
            raise UserError("give --level or --resolution, not both.")
        if self.level is not None and not 0 <= self.level < 32:
            raise UserError(f"--level must be from 0 to 31, got {self.level}.")
        if self.resolution is not None and not 0 < self.resolution < inf:
            raise UserError(f"--resolution must be a number above 0, got {self.resolution}.")

    @classmethod
    def parse(
        cls, bounds: str | None, level: int | None, resolution: float | None
    ) -> "Area | None":
        """Return the area of the options of a command line; None without any.

        Args:
            bounds: ``xmin,ymin,xmax,ymax`` or ``xmin,ymin,zmin,xmax,ymax,zmax``.
            level: see ``Area``.
            resolution: see ``Area``.
        """
        if bounds is None:
            levels = cls(level=level, resolution=resolution)
            return None if levels == cls() else levels
        numbers: list[float] = []
        with suppress(ValueError):
            numbers = [float(word) for word in bounds.split(",")]
        half = len(numbers) // 2
        low, high = numbers[:half], numbers[half:]
        if len(numbers) not in (4, 6) or not all(a < b for a, b in zip(low, high, strict=True)):
            raise UserError(
                "--bounds must be xmin,ymin,xmax,ymax or xmin,ymin,zmin,xmax,ymax,zmax with every "
                f"min below its max, got {bounds!r}."
            )
        flat = half == 2
        return cls((*low, *[-inf] * flat), (*high, *[inf] * flat), level, resolution)

    def clip(self, table: Table, path: Path) -> Table:
        """Return the points of a file that are in the box.

        Raises:
            BadCloudError: the area has levels, but the file has none.
        """
        if self.level is not None or self.resolution is not None:
            raise BadCloudError(
                f"{path}: --level and --resolution need a COPC file, which has levels of detail. "
                "Use --bounds alone, or --method voxel."
            )
        inside = ((table.points >= self.low) & (table.points <= self.high)).all(axis=1)
        return table if inside.all() else table.take(np.flatnonzero(inside))
