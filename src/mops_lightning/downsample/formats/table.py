"""A cloud as its file has it: coordinates, and columns of whatever else."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.errors import UserError

Column = NDArray[Any]


class BadCloudError(UserError):
    """A file that holds no cloud; others of its folder are done all the same."""


@dataclass(frozen=True)
class Table:
    """Points and their attributes.

    Attributes:
        points: ``(N, 3)`` float64 coordinates in the file's own unit.
        columns: further numbers per point, ``(N,)`` each, under the file's names. Texts, dates and
            lists are left out.
        head: what a format needs to write the like again (LAS: its header).
    """

    points: NDArray[np.float64]
    columns: Mapping[str, Column] = field(default_factory=dict)
    head: Any = None

    def take(self, rows: NDArray[np.int64]) -> "Table":
        """Return some of the points with all that belongs to them."""
        columns = {name: column[rows] for name, column in self.columns.items()}
        return Table(self.points[rows], columns, self.head)

    def finite(self) -> "Table":
        """Return the points whose coordinates are all finite."""
        finite = np.isfinite(self.points).all(axis=1)
        return self if finite.all() else self.take(np.flatnonzero(finite))

    def bare(self) -> "Table":
        """Return the points alone."""
        return Table(self.points, {}, self.head)


def total(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sum ``(3,)`` of points ``(n, 3)``, which may be infinite."""
    with np.errstate(over="ignore", invalid="ignore"):
        return points.sum(0)


def reach(points: NDArray[np.float64], centre: NDArray[np.float64]) -> float:
    """Return how far the farthest of ``(n, 3)`` points lies from ``centre``, ``(3,)``."""
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.linalg.norm(points - centre, axis=1).max(initial=0.0))


def radius_of(distance: float, path: Path) -> float:
    """Return by what to divide a cloud whose farthest point has this distance from its centre.

    Raises:
        BadCloudError: it is too far for the number to be finite.
    """
    if not np.isfinite(distance):
        raise BadCloudError(f"{path} has coordinates too large to be measured.")
    return distance or 1.0


RESERVED = ("x", "y", "z", "points")


def unique_names(table: Table) -> dict[str, Column]:
    """Return the columns under names that a file's head can hold: no blanks, no two the same."""
    named: dict[str, Column] = {}
    for name, column in table.columns.items():
        plain = "_".join(name.split()) or "column"
        while plain.lower() in RESERVED or plain in named:
            plain += "_"
        named[plain] = column
    return named


def coordinates(table: Table) -> NDArray[Any]:
    """Return the points as float32 where that moves none by a millionth of the cloud's size."""
    single = table.points.astype("<f4")
    finite = np.isfinite(table.points).all(axis=1)
    lost = np.abs(single - table.points)[finite].max(initial=0.0)
    extent = np.ptp(table.points[finite], axis=0).max() if finite.any() else 0.0
    return single if lost <= 1e-6 * extent else table.points


def from_array(array: NDArray[Any], names: list[str], path: Path, head: Any = None) -> Table:
    """Make a table of the columns of a plain or structured array.

    Args:
        array: ``(N, K)``, K ≥ 3, or ``(N,)`` with named fields.
        names: of the columns; x, y and z must be among them.
        path: for errors.
        head: see ``Table``.

    Raises:
        BadCloudError: there are no coordinates.
    """
    lower = {name.lower(): name for name in reversed(names)}
    if not {"x", "y", "z"} <= set(lower):
        raise BadCloudError(f"{path} has no x, y and z; its columns are {', '.join(names)}.")

    def column(name: str) -> Column:
        return array[name] if array.dtype.names else array[:, names.index(name)]

    axes = [lower[axis] for axis in "xyz"]
    for name in axes:
        if column(name).dtype.kind not in "fiu":
            raise BadCloudError(f"{path}: {name} must be numbers, got {column(name).dtype}.")
    points = np.stack([np.asarray(column(axis), np.float64) for axis in axes], 1)
    rest = {name: column(name) for name in names if name not in axes}
    numbers = {name: c for name, c in rest.items() if c.ndim == 1 and c.dtype.kind in "fiub"}
    return Table(points, numbers, head)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Name the file in whatever a broken one makes the parsers stumble over.

    Raises:
        BadCloudError: in place of any error but ``UserError``.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        raise BadCloudError(f"{path} is broken: {type(error).__name__}: {error}.") from None


def check_enough(path: Path, number: int, m: int) -> None:
    """Refuse a cloud of fewer points than are to be kept.

    Raises:
        BadCloudError: it has fewer.
    """
    if number < m:
        raise BadCloudError(f"{path} holds {number} points, fewer than --m {m}.")


def ends_early(path: Path, number: int) -> BadCloudError:
    """Say that a file holds fewer points than it announces."""
    return BadCloudError(f"{path} is broken: it ends after {number} points.")


def column_names(array: NDArray[Any], path: Path) -> list[str]:
    """Return the names of the columns of an array: its fields, or x, y, z, column_3 and so on.

    Args:
        array: plain or structured; its numbers are not read.
        path: for errors.

    Raises:
        BadCloudError: it holds no rows of three numbers or more, nor one row of fields a point.
    """
    shape, kind = array.shape, array.dtype.kind
    if array.dtype.names:
        if array.ndim != 1:
            raise BadCloudError(f"{path} must hold one row of fields a point, got {shape}.")
        return list(array.dtype.names)
    if len(shape) != 2 or shape[1] < 3 or kind not in "fiu":
        raise BadCloudError(
            f"{path} must hold numbers in rows of x, y, z, got {array.dtype} of shape {shape}."
        )
    return ["x", "y", "z", *(f"column_{place}" for place in range(3, shape[1]))]
