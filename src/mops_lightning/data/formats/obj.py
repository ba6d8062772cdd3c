"""Wavefront OBJ files without faces: coordinates alone."""

import re
from pathlib import Path

import numpy as np

from mops_lightning.data.formats.errors import BadCloudError
from mops_lightning.data.formats.table import Table, compact_coordinates
from mops_lightning.data.formats.text import number_format


def read(path: Path) -> Table | None:
    """Read the vertices; None for a mesh, which has faces as well.

    Raises:
        BadCloudError: there are no vertices.
    """
    data = path.read_bytes()
    if re.search(rb"^f\s", data, re.M):
        return None
    words = [line.split()[1:4] for line in data.splitlines() if line[:2] in (b"v ", b"v\t")]
    if not words:
        raise BadCloudError(f"{path} holds no vertices.")
    return Table(np.array(words, np.float64))


def write(path: Path, table: Table) -> None:
    """Write the vertices."""
    points = compact_coordinates(table)
    np.savetxt(path, points, fmt=f"v {' '.join([number_format(points)] * 3)}")
