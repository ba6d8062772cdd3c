"""COPC files whose octree has several pages, as those of many cells have."""

import laspy
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mops_lightning.data.formats.area import Area
from mops_lightning.data.formats.registry import read
from tests.support.cloud_files import contents
from tests.support.clouds import uniform_points
from tests.support.copc import write_copc

POINTS = 100 * uniform_points(3000, 0)


@pytest.fixture
def paged(tmp_path):
    path = tmp_path / "a.copc.laz"
    write_copc(path, POINTS, spacing=16.0, depth=2, each=50, in_pages=True)
    return path


def rows_of(table):
    return sorted(table.columns["intensity"].tolist())


@pytest.mark.parametrize(("level", "number"), [(0, 50), (1, 450), (2, 3000)])
def test_area_by_level_has_the_cells_of_all_pages(level, number, paged):
    with laspy.CopcReader.open(paged) as reader:
        expected = sorted(reader.query(level=range(level + 1)).intensity.tolist())

    table = read(paged, 1, 0, Area(level=level))

    assert rows_of(table) == expected
    assert len(table.points) == number


def test_area_by_bounds_has_the_cells_of_the_pages_that_it_overlaps(paged):
    low = np.array([0.0, 0.0, 0.0])
    high = np.array([40.0, 90.0, 30.0])

    table = read(paged, 1, 0, Area(tuple(low), tuple(high)))

    written = contents(paged)
    is_inside = ((written.points >= low) & (written.points <= high)).all(1)
    assert rows_of(table) == sorted(written.columns["intensity"][is_inside].tolist())
    assert_array_equal(rows_of(written), np.arange(3000))
