"""LAS and LAZ files."""

import laspy
import numpy as np
import pytest

from mops_lightning.data.formats.registry import WRITERS, open_cloud_file, read
from mops_lightning.data.formats.table import Table
from mops_lightning.errors import UserError


def test_las_keeps_format_scale_and_dimensions(tmp_path):
    cloud = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    cloud.header.offsets, cloud.header.scales = [1000] * 3, [0.01] * 3
    cloud.x, cloud.y, cloud.z = np.random.default_rng(0).uniform(1000, 1001, (3, 30))
    cloud.intensity = np.arange(30)
    cloud.write(tmp_path / "a.las")
    table = read(tmp_path / "a.las", 100, 0)
    WRITERS[".las"](tmp_path / "b.las", table.take(np.array([3, 5])))
    again = laspy.read(tmp_path / "b.las")
    assert again.header.point_format.id == 6
    assert list(again.intensity) == [3, 5]
    np.testing.assert_array_equal(again.header.scales, [0.01] * 3)


@pytest.mark.parametrize("chunked", [True, False])
def test_las_truncated_between_points_is_broken(chunked, tmp_path):
    path = tmp_path / "a.las"
    points = np.random.default_rng(1).normal(size=(90, 3))
    WRITERS[".las"](path, Table(points))
    with laspy.open(path) as file:
        length = file.header.point_format.size
    path.write_bytes(path.read_bytes()[: -30 * length])
    with pytest.raises(UserError, match="ends after 60 points"):
        open_cloud_file(path).read(range(90)) if chunked else read(path, 9, 0)


@pytest.mark.parametrize("size", [500, 3000])
def test_laz_damaged_is_broken(size, tmp_path):
    path = tmp_path / "a.laz"
    WRITERS[".laz"](path, Table(np.random.default_rng(1).uniform(0, 50, size=(3000, 3))))
    content = bytearray(path.read_bytes())
    content[600:1500] = bytes(np.random.default_rng(2).integers(0, 256, 900, np.uint8))
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"a\.laz is broken"):
        open_cloud_file(path).read(range(size))
