"""The normals that a file has for its points."""

import numpy as np
from numpy.typing import NDArray

from mops_lightning.channels import NORMALS
from mops_lightning.data.features import stored_values
from mops_lightning.data.formats.table import Table


def normals_of(table: Table) -> NDArray[np.float64] | None:
    """Return the unit normals ``(N, 3)`` in a file's columns.

    Returns:
        None where the file has none, or where a point has none: one that is zero or not finite.
    """
    normals = stored_values(table, NORMALS)
    if normals is None:
        return None
    are_finite = np.isfinite(normals).all()
    if not are_finite or not normals.any(axis=1).all():
        return None
    return normals
