"""Samplers by normals take the normals of a file, where it has them."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mops_lightning.data.features import STORED_NORMALS
from mops_lightning.files.column_means import renormalise
from mops_lightning.files.compare import compare_file, options_by_method
from mops_lightning.files.downsample import downsample_file
from mops_lightning.files.options import Options
from tests.support.cloud_files import contents, write_cloud
from tests.support.clouds import uniform_points

UP = {"nx": 0.0, "ny": 0.0, "nz": 1.0}


ACROSS = [3, 50, 150]
"""Points that have another normal."""


def across_of(length):
    """Return the x of normals, which is not 0 for three points."""
    across = np.zeros(200, np.float32)
    across[ACROSS] = length
    return across


def flat_cloud():
    points = uniform_points(200, 0)
    points[:, 2] = 0
    return points


def sampled(tmp_path, columns):
    """Sample a flat cloud of which three points have another normal."""
    source = tmp_path / "in.ply"
    target = tmp_path / "out.ply"
    filled = {}
    for name, value in UP.items():
        filled[name] = np.full(200, value, np.float32)
    filled.update(columns)
    write_cloud(source, flat_cloud(), filled)
    options = Options(6, method="normal_space", coordinates_only=False)
    downsample_file(source, target, options)
    return contents(target)


def test_normal_space_takes_points_by_the_normals_of_the_file(tmp_path):
    across = across_of(2.0)
    up = np.float32(across == 0)

    kept = sampled(tmp_path, {"nx": across, "nz": up})

    of_other_normal = np.count_nonzero(kept.columns["nx"])
    assert of_other_normal == 3


def test_compare_measures_the_points_that_downsample_keeps(tmp_path):
    source = tmp_path / "in.ply"
    points = flat_cloud()
    across = across_of(1.0)
    columns = {
        "nx": across,
        "ny": np.zeros(200, np.float32),
        "nz": np.float32(across == 0),
    }
    write_cloud(source, points, columns)
    methods = options_by_method(6, ["normal_space"], None, None, 0)

    compared = compare_file(source, 6, methods, 0)

    rows = compared.results[0].rows
    assert set(rows.tolist()) > set(ACROSS)
    kept = sampled(tmp_path, columns)
    assert_array_equal(kept.points, points[rows])


@pytest.mark.parametrize("wrong", [0.0, np.nan])
def test_normals_are_estimated_where_a_point_of_the_file_has_none(tmp_path, wrong):
    across = across_of(2.0)
    up = np.ones(200, np.float32)
    up[ACROSS] = 0.0
    up[7] = wrong

    kept = sampled(tmp_path, {"nx": across, "nz": up})

    is_across = kept.columns["nx"] == 2
    assert is_across.sum() < 3


@pytest.mark.parametrize("names", STORED_NORMALS)
def test_means_of_normals_have_length_1_under_every_name(names):
    x, y, z = names
    columns = {
        x: np.array([0, 0], np.float32),
        y: np.array([3, 0], np.float32),
        z: np.array([4, 0], np.float32),
    }

    renormalise(columns)

    assert columns[x].tolist() == [0, 0]
    assert columns[y].tolist() == [np.float32(0.6), 0]
    assert columns[z].tolist() == [np.float32(0.8), 0]
    assert columns[z].dtype == np.float32
