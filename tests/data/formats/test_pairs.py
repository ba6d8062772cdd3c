"""Every pair of formats: what goes in comes out."""

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mops_lightning.data.formats.registry import write
from mops_lightning.data.formats.table import Form, Table
from tests.support.cloud_files import contents

EXACT = (".ply", ".pcd", ".npz", ".txt", ".xyz", ".npy")
"""Formats that hold float64 coordinates."""

NAMED = (".ply", ".pcd", ".npz", ".txt", ".xyz", ".las", ".laz")
"""Formats with names of columns."""


@pytest.fixture
def table():
    random = np.random.default_rng(0)
    columns: dict[str, Any] = {
        "red": random.integers(0, 256, 50, np.uint8),
        "part": random.integers(-9, 9, 50, np.int32),
        "score": random.random(50, np.float32),
        "time": 3e8 + random.random(50),
    }
    in_metres = random.normal(0, 3, (50, 3))
    points = in_metres + np.array([400_000.125, 5_000_000.25, 0])
    float64 = Form(np.dtype(np.float64))
    return Table(points, columns, form=float64)


@pytest.mark.parametrize("source", EXACT)
@pytest.mark.parametrize("target", EXACT)
def test_coordinates_of_every_pair_are_the_same_to_the_bit(source, target, table, tmp_path):
    first = tmp_path / f"a{source}"
    second = tmp_path / f"b{target}"

    write(first, table)
    write(second, contents(first))

    again = contents(second)
    assert_array_equal(again.points, table.points)


@pytest.mark.parametrize("source", NAMED)
@pytest.mark.parametrize("target", NAMED)
def test_columns_of_every_pair_keep_names_and_numbers(source, target, table, tmp_path):
    first = tmp_path / f"a{source}"
    second = tmp_path / f"b{target}"

    write(first, table)
    write(second, contents(first))

    again = contents(second).columns
    for name, column in table.columns.items():
        # Text is read as float64, a LAS dimension of the name may have another type.
        kept = again.get(f"{name}_", again[name])
        assert_array_equal(kept.astype(column.dtype), column)
