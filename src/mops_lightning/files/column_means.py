"""Which columns have a mean, and how it is stored."""

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.features import STORED_NORMALS
from mops_lightning.data.formats.table import Column, Table

AVERAGED = {
    "red",
    "green",
    "blue",
    "nir",
    "alpha",
    "intensity",
    "r",
    "g",
    "b",
    "a",
    "diffuse_red",
    "diffuse_green",
    "diffuse_blue",
}
"""Columns of whole numbers that are quantities; others are names, of which there is no mean."""

PACKED = {"rgb", "rgba"}
"""Columns whose bits are colours (PCD)."""


def averaged(table: Table) -> list[str]:
    """Return the names of columns that have a mean."""
    return [name for name, column in table.columns.items() if _is_averaged(name, column)]


def _is_averaged(name: str, column: Column) -> bool:
    plain = name.lower()
    if column.ndim != 1 or plain in PACKED:
        return False
    return column.dtype.kind == "f" or plain in AVERAGED


def values_of(table: Table, names: list[str]) -> NDArray[np.float64]:
    """Return the values ``(N, names)`` of columns."""
    if not names:
        return np.empty((len(table.points), 0))
    columns = [table.columns[name].astype(np.float64) for name in names]
    return np.stack(columns, axis=1)


def as_stored(means: NDArray[np.float64], column: Column) -> Column:
    """Return means in the type of their column, rounded where it holds whole numbers."""
    if column.dtype.kind != "f":
        means = np.rint(means)
    return means.astype(column.dtype)


def renormalise(columns: dict[str, Column]) -> None:
    """Scale normals to length 1; those that cancel out stay 0."""
    for names in STORED_NORMALS:
        if all(name in columns for name in names):
            axes = [columns[name].astype(np.float64) for name in names]
            normals = np.stack(axes, axis=1)
            lengths = np.linalg.norm(normals, axis=1, keepdims=True)
            zeros = np.zeros_like(normals)
            normals = np.divide(normals, lengths, out=zeros, where=lengths > 0)
            for name, values in zip(names, normals.T, strict=True):
                columns[name] = values.astype(columns[name].dtype)
