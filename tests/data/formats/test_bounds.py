"""Areas of clouds on a grid, with points exactly on the bounds."""

import numpy as np
import pytest

from mops_lightning.data.formats.area import Area
from mops_lightning.data.formats.registry import open_cloud_file, read, write
from mops_lightning.data.formats.table import Table
from tests.support.copc import write_copc

GRID = np.indices((5, 5, 5), np.float64).reshape(3, 125).T
"""125 points with coordinates 0 to 4."""


@pytest.fixture(params=["grid.npy", "grid.ply", "grid.las", "grid.copc.laz"])
def grid(request, tmp_path):
    path = tmp_path / request.param
    if path.name.endswith(".copc.laz"):
        write_copc(path, GRID, spacing=1.0, depth=1, each=20)
    else:
        write(path, Table(GRID))
    return path


def test_bounds_without_z_keep_points_below_zero(tmp_path):
    path = tmp_path / "a.ply"
    low_high_outside = np.array(
        [
            [1.0, 1.0, -7.0],
            [1.0, 1.0, 7.0],
            [9.0, 1.0, 0.0],
        ]
    )
    write(path, Table(low_high_outside))
    area = Area.parse("0,0,2,2", None, None)

    inside = read(path, 1, 0, area)

    assert inside.points[:, 2].tolist() == [-7.0, 7.0]


def rows_between(low, high):
    """Return the points of the grid from low to high, both included, sorted."""
    is_inside = (low <= GRID) & (high >= GRID)
    return GRID[is_inside.all(1)].tolist()


@pytest.mark.parametrize(
    ("bounds", "expected"),
    [
        ("1,1,1,3,3,3", rows_between((1, 1, 1), (3, 3, 3))),
        ("0,0,0,4,4,1", rows_between((0, 0, 0), (4, 4, 1))),
        ("0,0,3,4,4,9", rows_between((0, 0, 3), (4, 4, 4))),
        ("1,2,3,3", rows_between((1, 2, 0), (3, 3, 4))),
        ("-9,-9,-9,1,0,0", rows_between((0, 0, 0), (1, 0, 0))),
    ],
)
def test_area_of_bounds_holds_the_points_on_them_and_none_beyond(grid, bounds, expected):
    area = Area.parse(bounds, None, None)

    whole = read(grid, 1, 0, area)
    opened = open_cloud_file(grid, area)
    parts = []
    for rows in opened.row_ranges(40):
        parts.extend(opened.read(rows).points.tolist())

    assert sorted(whole.points.tolist()) == expected
    assert sorted(parts) == expected
