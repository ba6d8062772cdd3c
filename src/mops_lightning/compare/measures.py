"""What a sample of a cloud is worth, without any task: distances, density, thin parts, attributes.

All distances are in the file's own unit, and not squared.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mops_lightning.data.formats.table import Table

Points = NDArray[np.float64]
Rows = NDArray[np.int64]

EVALUATED = 500_000
"""Most input points at which distances and attributes are measured."""

LOCAL = 50_000
"""Most input points at which thin parts and normals are estimated."""

NEIGHBOURS = 48
"""Most points of a neighbourhood for thin parts: a disc has about so many."""

LINEAR = 0.75
"""Share of the largest variance by which it exceeds the second one in thin parts."""

ATTRIBUTES = {
    "intensity": ("intensity", "reflectance", "reflectivity", "scalar_intensity"),
    "colour": ("red", "green", "blue", "r", "g", "b"),
}
"""Attributes by the names that their columns have in files."""

NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))


@dataclass(frozen=True)
class Measures:
    """One sample of one cloud.

    Attributes:
        chamfer: mean distance from an input point to the nearest kept point. All kept points are
            input points, so that the other direction of the chamfer distance is 0.
        hausdorff: the largest of these distances.
        density: standard deviation over mean of the number of input points that a kept point is
            nearest to; 0 if the sample is as dense as the input everywhere.
        thin: as chamfer, from the input points on thin parts; None if there are none.
        attributes: mean absolute difference between an input point and its nearest kept point, over
            the attribute's standard deviation; for ``intensity`` and ``colour``, if there are any.
        normals: mean angle in degrees between their normals; None if they cannot be estimated.
    """

    chamfer: float
    hausdorff: float
    density: float
    thin: float | None
    attributes: dict[str, float]
    normals: float | None


@dataclass(frozen=True)
class Reference:
    """What all samples of one cloud are compared with.

    Attributes:
        table: the cloud.
        rows: input points at which distances are measured.
        local: some of ``rows``.
        thin: which of ``local`` are on thin parts.
        spacing: median distance between neighbours in an even sample.
        tree: KD-tree of the cloud.
    """

    table: Table
    rows: Rows
    local: Rows
    thin: NDArray[np.bool_]
    spacing: float
    tree: Any

    @classmethod
    def of(cls, table: Table, kept: Rows, seed: int = 0) -> "Reference":
        """Measure a cloud.

        Args:
            table: its points are finite.
            kept: rows of an even sample, such as farthest points; its median distance between
                neighbours is the spacing.
            seed: of the input points that are evaluated, if there are too many.
        """
        rng = np.random.default_rng(seed)
        number = len(table.points)
        order = rng.permutation(number)
        sample = table.points[kept]
        k = min(2, len(sample))
        spacing = float(np.median(np.asarray(cKDTree(sample).query(sample, k=k)[0])[..., -1]))
        rows, local = np.sort(order[:EVALUATED]), np.sort(order[:LOCAL])
        thin = thin_parts(table.points, local, spacing)
        return cls(table, rows, local, thin, spacing, cKDTree(table.points))

    def measure(self, kept: Rows) -> Measures:
        """Return the measures of the sample in ``kept``, rows of the cloud."""
        points = self.table.points
        tree = cKDTree(points[kept])
        distance, owner = _nearest(tree, points[self.rows])
        members = np.bincount(owner, minlength=len(kept))
        near, local_owner = _nearest(tree, points[self.local])
        thin = near[self.thin]
        return Measures(
            float(distance.mean()),
            float(distance.max()),
            float(members.std() / members.mean()),
            float(thin.mean()) if len(thin) else None,
            self._attributes(kept[owner]),
            self._normal_error(kept[local_owner]),
        )

    def _attributes(self, nearest: Rows) -> dict[str, float]:
        """Return the errors of intensity and colour; that of a colour is the mean of its parts."""
        errors = {}
        for name, parts in ATTRIBUTES.items():
            found = [self._error(column, nearest) for column in self._columns(parts)]
            known = [error for error in found if error is not None]
            if known:
                errors[name] = sum(known) / len(known)
        return errors

    def _columns(self, names: Sequence[str]) -> list[NDArray[np.float64]]:
        columns = self.table.columns.items()
        return [column.astype(np.float64) for name, column in columns if name.lower() in names]

    def _error(self, column: NDArray[np.float64], nearest: Rows) -> float | None:
        spread = column[self.rows].std()
        if not (np.isfinite(spread) and spread > 0):
            return None
        return float(np.abs(column[self.rows] - column[nearest]).mean() / spread)

    def _normal_error(self, nearest: Rows) -> float | None:
        """Return the mean angle between normals of ``local`` and of their nearest kept points."""
        if len(self.table.points) < 4:
            return None
        mine = normals_at(self.table, self.local, self.tree)
        unique, back = np.unique(nearest, return_inverse=True)
        theirs = normals_at(self.table, unique, self.tree)[back]
        cosine = np.abs((mine * theirs).sum(1)).clip(max=1)
        return float(np.degrees(np.arccos(cosine)).mean())


def _nearest(tree: Any, points: Points) -> tuple[Points, Rows]:
    distance, row = tree.query(points)
    return distance, row


def thin_parts(points: Points, rows: Rows, spacing: float) -> NDArray[np.bool_]:
    """Return which points are on parts that are thin at the scale of a sample, such as poles.

    The points within twice the spacing, thinned to a grid, are spread along a line.

    Args:
        points: ``(N, 3)``.
        rows: ``(k,)`` the points to judge.
        spacing: distance between neighbours in the sample.
    """
    if not spacing > 0:
        return np.zeros(len(rows), bool)
    # Not as integers: a stray point far away may have a cell that no integer holds.
    cell = np.floor((points - points.min(0)) / (spacing / 2))
    grid = points[np.unique(cell, axis=0, return_index=True)[1]]
    k = min(NEIGHBOURS, len(grid))
    found: Any = cKDTree(grid).query(points[rows], k=k, distance_upper_bound=2 * spacing)
    distance, row = (np.asarray(one).reshape(len(rows), k) for one in found)
    inside = np.isfinite(distance)
    variances = _variances(grid, np.where(inside, row, 0), inside)[0]
    linear = variances[:, 2] - variances[:, 1] >= LINEAR * variances[:, 2]
    result: NDArray[np.bool_] = linear & (variances[:, 2] > 0) & (inside.sum(1) >= 4)
    return result


def normals_at(table: Table, rows: Rows, tree: Any, k: int = 16) -> Points:
    """Return unit normals ``(len(rows), 3)``: those of the file, or of the k nearest points."""
    for axes in NORMALS:
        if set(axes) <= set(table.columns):
            normals = np.stack([table.columns[axis][rows].astype(np.float64) for axis in axes], 1)
            length = np.linalg.norm(normals, axis=1, keepdims=True)
            return normals / np.where(length > 0, length, 1.0)
    row = np.asarray(tree.query(table.points[rows], k=min(k, len(table.points)))[1])
    inside = np.ones(row.shape, bool)
    return _variances(table.points, row, inside)[1][:, :, 0]


def _variances(
    points: Points, row: Rows, inside: NDArray[np.bool_]
) -> tuple[Points, NDArray[np.float64]]:
    """Return the principal variances, ascending, and axes of neighbourhoods ``(k, n)``."""
    weight = inside / np.maximum(inside.sum(1, keepdims=True), 1)
    around = points[row]
    centred = around - (around * weight[..., None]).sum(1, keepdims=True)
    covariance = np.einsum("kni,knj,kn->kij", centred, centred, weight)
    values, axes = np.linalg.eigh(covariance)
    return values, axes


def lowest(values: Sequence[float | None]) -> int | None:
    """Return the position of the lowest value, or None if there is none or all are equal."""
    known = [(value, i) for i, value in enumerate(values) if value is not None]
    if not known or min(known)[0] == max(known)[0]:
        return None
    return min(known)[1]
