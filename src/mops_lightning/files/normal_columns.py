"""The normals that a file has for its points."""

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.table import Table

NAMES = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))
"""Names of the columns of normals: in PLY files, and in PCD files."""


def normals_of(table: Table) -> NDArray[np.float64] | None:
    """Return the unit normals ``(N, 3)`` in a file's columns.

    Returns:
        None where the file has none, or where a point has none: one that is zero or not finite.
    """
    for names in NAMES:
        if all(name in table.columns for name in names):
            normals = np.stack([np.asarray(table.columns[name], np.float64) for name in names], 1)
            lengths = np.linalg.norm(normals, axis=1, keepdims=True)
            is_usable = np.isfinite(lengths).all() and (lengths > 0).all()
            return normals / lengths if is_usable else None
    return None
