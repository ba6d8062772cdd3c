"""Attributes of a cloud by their names, as channels for a net."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.errors import BadCloudError
from mops_lightning.data.formats.table import Column, Table

PREFIX = "scalar_"
"""CloudCompare writes it before the names of its attributes."""

PACKED = {"red": 16, "green": 8, "blue": 0}
"""Bits to the right of a colour in the packed columns ``rgb`` and ``rgba`` of PCD files."""


def attribute_values(table: Table, names: Sequence[str], path: Path) -> NDArray[np.float64]:
    """Return attributes of a cloud as its file has them.

    Args:
        table: the cloud.
        names: of the attributes, in upper or lower case. CloudCompare's ``scalar_`` before a name
            may be left out, and ``red``, ``green`` and ``blue`` are also read from ``rgb``.
        path: the file, for errors.

    Returns:
        ``(N, C)``.

    Raises:
        BadCloudError: the file has no attribute of such a name, or values that are not finite.
    """
    values = np.empty((len(table.points), len(names)))
    for place, name in enumerate(names):
        values[:, place] = _column(table, name, path)
        wrong = int((~np.isfinite(values[:, place])).sum())
        if wrong:
            raise BadCloudError(
                f"{path}: {wrong} values of the attribute {name!r} are not finite. Clean the file, "
                f"or train without {name} in dataset.features."
            )
    return values


def _column(table: Table, name: str, path: Path) -> Column:
    known = {key.lower(): column for key, column in table.columns.items()}
    for key in (name.lower(), PREFIX + name.lower()):
        if key in known:
            return known[key]
    packed = known.get("rgb", known.get("rgba"))
    if name.lower() in PACKED and packed is not None and packed.dtype.itemsize == 4:
        bits = np.ascontiguousarray(packed).view(packed.dtype.str[0] + "u4")
        return bits >> PACKED[name.lower()] & 255
    raise BadCloudError(
        f"{path} has no attribute {name!r} as dataset.features asks for; it has "
        f"{', '.join(table.columns) or 'none'}."
    )
