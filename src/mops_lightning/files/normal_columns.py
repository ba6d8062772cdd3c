"""The normals that a file has for its points."""

import numpy as np
from numpy.typing import NDArray

from mops_lightning.channels import NORMALS
from mops_lightning.data.features import stored_names
from mops_lightning.data.formats.table import Table


def normals_of(table: Table) -> NDArray[np.float64] | None:
    """Return the unit normals ``(N, 3)`` in a file's columns.

    Returns:
        None where the file has none, or where a point has none: one that is zero or not finite.
    """
    names = stored_names(table, NORMALS)
    if not names:
        return None
    normals = np.stack([np.asarray(table.columns[name], np.float64) for name in names], 1)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    is_usable = np.isfinite(lengths).all() and (lengths > 0).all()
    return normals / lengths if is_usable else None
