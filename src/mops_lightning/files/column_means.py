"""Which columns have a mean, and how it is stored."""

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.features import STORED_NORMALS
from mops_lightning.data.formats.table import Column, Table

AVERAGED = {
    "red", "green", "blue", "nir", "alpha", "intensity", "r", "g", "b", "a",
    "diffuse_red", "diffuse_green", "diffuse_blue",
}  # fmt: skip
"""Columns of whole numbers that are quantities; others are names, of which there is no mean."""

PACKED = {"rgb", "rgba"}
"""Columns whose bits are colours (PCD)."""


def averaged(table: Table) -> list[str]:
    """Return the names of columns that have a mean."""
    return [
        name
        for name, column in table.columns.items()
        if column.ndim == 1
        and name.lower() not in PACKED
        and (column.dtype.kind == "f" or name.lower() in AVERAGED)
    ]


def values_of(table: Table, names: list[str]) -> NDArray[np.float64]:
    """Return the values ``(N, names)`` of columns."""
    if not names:
        return np.empty((len(table.points), 0))
    return np.stack([table.columns[name].astype(np.float64) for name in names], axis=1)


def as_stored(means: NDArray[np.float64], column: Column) -> Column:
    """Return means in the type of their column, rounded where it holds whole numbers."""
    if column.dtype.kind != "f":
        means = np.rint(means)
    return means.astype(column.dtype)


def renormalise(columns: dict[str, Column]) -> None:
    """Scale normals to length 1; those that cancel out stay 0."""
    for names in STORED_NORMALS:
        if all(name in columns for name in names):
            normals = np.stack([columns[name].astype(np.float64) for name in names], axis=1)
            lengths = np.linalg.norm(normals, axis=1, keepdims=True)
            normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
            for name, values in zip(names, normals.T, strict=True):
                columns[name] = values.astype(columns[name].dtype)
