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
        cls,
        bounds: str | None,
        level: int | None,
        resolution: float | None,
    ) -> "Area | None":
        """Return the area of the options of a command line; None without any.

        Args:
            bounds: ``xmin,ymin,xmax,ymax`` or ``xmin,ymin,zmin,xmax,ymax,zmax``.
            level: see ``Area``.
            resolution: see ``Area``.
        """
        if bounds is None:
            levels = cls(level=level, resolution=resolution)
            if levels == cls():
                return None
            return levels
        numbers: list[float] = []
        with suppress(ValueError):
            numbers = [float(word) for word in bounds.split(",")]
        half = len(numbers) // 2
        low = numbers[:half]
        high = numbers[half:]
        has_length = len(numbers) in (4, 6)
        if not has_length or not _are_below(low, high):
            raise UserError(
                "--bounds must be xmin,ymin,xmax,ymax or xmin,ymin,zmin,xmax,ymax,zmax with every "
                f"min below its max, got {bounds!r}."
            )
        if half == 2:
            low.append(-inf)
            high.append(inf)
        return cls(tuple(low), tuple(high), level, resolution)

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
        is_inside = (table.points >= self.low) & (table.points <= self.high)
        rows = is_inside.all(axis=1)
        if rows.all():
            return table
        return table.take(np.flatnonzero(rows))


def _are_below(low: list[float], high: list[float]) -> bool:
    return all(least < most for least, most in zip(low, high, strict=True))
