from pathlib import Path

import numpy as np
import pytest

from mops_lightning.data.formats.attributes import attribute_values
from mops_lightning.data.formats.registry import WRITERS, read
from mops_lightning.data.formats.table import Table
from mops_lightning.errors import UserError

POINTS = np.random.default_rng(0).normal(size=(40, 3))


def values(columns, names):
    return attribute_values(Table(POINTS, columns), names, Path("scan.ply"))


def test_attribute_values_has_columns_in_the_order_of_names():
    columns = {"Red": np.arange(40, dtype="u1"), "scalar_Intensity": np.linspace(0, 1, 40)}
    found = values(columns, ["intensity", "red"])
    np.testing.assert_array_equal(found, np.stack([np.linspace(0, 1, 40), np.arange(40)], 1))
    assert values(columns, ()).shape == (40, 0)


@pytest.mark.parametrize("kind", ["<f4", "<u4", ">u4"])
def test_attribute_values_unpacks_colours(kind):
    colours = np.random.default_rng(1).integers(0, 256, (40, 3))
    packed = (colours @ [65536, 256, 1]).astype(kind.replace("f", "u")).view(kind)
    np.testing.assert_array_equal(values({"rgb": packed}, ["red", "green", "blue"]), colours)


def test_attribute_values_missing_attribute_names_file_and_what_it_has():
    columns = {"gps_time": np.zeros(40), "red": np.zeros(40)}
    with pytest.raises(UserError, match=r"scan\.ply.*'intensity'.*features.*gps_time, red"):
        values(columns, ["red", "intensity"])
    with pytest.raises(UserError, match=r"'blue'.*has none"):
        values({}, ["blue"])


def test_attribute_values_not_finite_raises():
    with pytest.raises(UserError, match=r"scan\.ply: 2 values .*'nx' are not finite"):
        values({"nx": np.array([np.nan, np.inf, *[0.0] * 38])}, ["nx"])


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".bin", ".npz", ".xyz", ".txt", ".las"])
def test_attribute_values_of_every_format_with_names(suffix, tmp_path):
    if suffix == ".las":
        pytest.importorskip("laspy")
    path = tmp_path / f"scan{suffix}"
    WRITERS[suffix](path, Table(POINTS, {"intensity": np.arange(40, dtype="u2")}))
    found = attribute_values(read(path, 1, 0), ["intensity"], path)
    np.testing.assert_array_equal(found[:, 0], np.arange(40))
