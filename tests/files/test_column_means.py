"""Which columns have a mean, and how it is stored."""

import numpy as np
import pytest

from mops_lightning.data.formats.table import Table
from mops_lightning.files.column_means import as_stored, averaged

QUANTITIES = (
    "red",
    "green",
    "blue",
    "nir",
    "alpha",
    "intensity",
    "r",
    "g",
    "b",
    "a",
    "diffuse_red",
    "diffuse_green",
    "diffuse_blue",
    "Intensity",
)
NAMES = ("classification", "label", "point_source_id", "rgb", "rgba")
"""Columns of whole numbers that have no mean."""


@pytest.mark.parametrize("name", [*QUANTITIES, *NAMES])
def test_whole_numbers_have_a_mean_where_they_are_quantities(name):
    table = Table(np.zeros((2, 3)), {name: np.array([1, 2], np.uint8)})

    names = averaged(table)

    assert names == ([name] if name in QUANTITIES else [])


@pytest.mark.parametrize("name", ["height", "label", "nx"])
def test_fractions_have_a_mean(name):
    table = Table(np.zeros((2, 3)), {name: np.array([0.5, 2])})

    assert averaged(table) == [name]


@pytest.mark.parametrize("name", ["rgb", "RGBA"])
def test_packed_colours_have_no_mean(name):
    table = Table(np.zeros((2, 3)), {name: np.array([0.5, 2], np.float32)})

    assert averaged(table) == []


def test_means_of_whole_numbers_are_rounded():
    means = np.array([1.4, 1.6, 254.9])

    in_bytes = as_stored(means, np.zeros(1, np.uint8))
    in_floats = as_stored(means, np.zeros(1, np.float32))

    assert in_bytes.tolist() == [1, 2, 255]
    assert in_bytes.dtype == np.uint8
    assert in_floats.tolist() == np.float32(means).tolist()
