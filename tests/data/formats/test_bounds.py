"""Areas of clouds on a grid, with points exactly on the bounds."""

import numpy as np
import pytest

from mops_lightning.data.formats.area import Area
from mops_lightning.data.formats.registry import open_cloud_file, read, write
from mops_lightning.data.formats.table import Table
from mops_lightning.errors import UserError
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


def test_bounds_of_a_bin_file_hold_for_its_named_columns(tmp_path):
    path = tmp_path / "a.bin"
    rows = np.array([[0, 1, 2, 3], [0, 5, 6, 7]], "<f4")
    rows.tofile(path)
    columns = ("time", "x", "y", "z")

    inside = read(path, 1, 0, Area.parse("0,0,3,3", None, None), columns)

    assert inside.points.tolist() == [[1, 2, 3]]


def test_bounds_of_a_mesh_hold_for_its_vertices(tmp_path):
    path = tmp_path / "a.off"
    path.write_text("OFF\n3 1 0\n0 0 0\n9 0 0\n0 9 0\n3 0 1 2\n")
    area = Area.parse("-1,-1,1,9", None, None)

    inside = read(path, 50, 0, area, vertices=True)

    assert inside.points.tolist() == [[0, 0, 0], [0, 9, 0]]


@pytest.mark.parametrize(("level", "resolution"), [(1, None), (None, 0.5)])
def test_bounds_with_a_level_or_a_resolution_need_a_file_with_levels(level, resolution, tmp_path):
    path = tmp_path / "a.ply"
    write(path, Table(GRID))
    area = Area.parse("0,0,2,2", level, resolution)

    with pytest.raises(UserError, match="--level and --resolution need a COPC file"):
        read(path, 1, 0, area)


@pytest.mark.parametrize("bounds", ["0,0,0,2", "2,0,0,2", "0,0,5,1,1,5", "0,0,2", "a,0,2,2"])
def test_bounds_whose_min_is_not_below_the_max_are_refused(bounds):
    with pytest.raises(UserError, match="every min below its max"):
        Area.parse(bounds, None, None)


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
