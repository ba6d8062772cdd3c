"""Weights of points, from a column of their file."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from mops_lightning.data.formats.guard import BadCloudError
from mops_lightning.data.formats.table import Table
from mops_lightning.errors import did_you_mean
from mops_lightning.ops.weights import CURVATURE, check_weight, curvature

SPLAT = {"opacity", "f_dc_0", "scale_0", "rot_0"}
"""Columns of a splat file (Kerbl et al., "3D Gaussian Splatting", SIGGRAPH 2023)."""


def weights_of(table: Table, field: str, source: Path) -> NDArray[np.float64]:
    """Return one number of at least 0 per point.

    Args:
        table: of finite points.
        field: a column, or ``curvature``. Splat files hold the logit of the opacity; its weight is
            the opacity itself.
        source: the file, for errors.

    Raises:
        UserError: there is no such column, or it holds numbers that are no weights.
    """
    values = table.columns.get(field)
    if values is None and field == CURVATURE:
        return curvature(table.points)
    if values is None:
        hint = did_you_mean(field, {*table.columns, CURVATURE})
        raise BadCloudError(f"--weight: {source} has no column {field!r}.{hint}")
    values = values.astype(np.float64)
    if field == "opacity" and table.columns.keys() >= SPLAT:
        values = expit(values)
    name = f"--weight {field} of {source}"
    weight = check_weight(values, values.shape, name)
    return weight.numpy()
