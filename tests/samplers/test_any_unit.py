"""Samplers that need no unit sphere choose as in it, in any unit, order and place."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mops_lightning import FPSSampler, RandomSampler, downsample
from mops_lightning.files.downsample import sample_cloud
from mops_lightning.files.options import Options
from mops_lightning.ops.points import UnitSphere, gather_points
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.ordering import in_unit_sphere
from mops_lightning.zoo.find_sampler import untrained
from tests.support.clouds import cloud_of

METHODS = ["fps", "random", "serial", "poisson"]


def sampler_of(method, m, seed):
    sampler = untrained(method, m, seed)
    assert sampler.any_unit
    return sampler


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("number", [50, 600])
def test_rows_are_those_of_the_cloud_in_the_unit_sphere(method, number, randn):
    points = randn(3, number, 3) * 40 + 7
    sampler = sampler_of(method, 20, 3)

    _, rows = sampler.downsample(points)

    expected = sampler(in_unit_sphere(points)).indices
    assert torch.equal(rows, expected)


@pytest.mark.parametrize("method", ["fps", "random", "poisson"])
def test_rows_by_weight_are_those_of_the_cloud_in_the_unit_sphere(method, randn, rand):
    points = randn(3, 50, 3) * 40 + 7
    weight = rand(3, 50) + 0.1
    sampler = sampler_of(method, 20, 3)

    _, rows = sampler.downsample(points, weight=weight)

    expected = sampler.sample_weighted(in_unit_sphere(points), 20, weight)
    assert torch.equal(rows, expected)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", ["sphere", "grid", "copies", "one point", "offset", "outlier"])
def test_points_do_not_depend_on_the_order_of_the_input(method, kind, rng):
    (points,) = cloud_of(kind, (1, 300), torch.float64, rng)
    order = torch.randperm(300, generator=rng)

    chosen, _ = downsample(points, 40, method)
    chosen_of_shuffled, _ = downsample(points[order], 40, method)

    assert torch.equal(chosen_of_shuffled, chosen)


@pytest.mark.parametrize("method", METHODS)
def test_points_of_a_map_are_chosen_alike_in_python_and_by_the_command_line(method, rand):
    points = rand(500, 3, dtype=torch.float64) * 90
    points += torch.tensor([637_012.25, 5_851_993.5, 411.0], dtype=torch.float64)

    seed = 8
    if method == "serial":  # it takes no seed
        seed = 0

    _, rows = downsample(points, 30, method, seed=seed)

    sampler = sampler_of(method, 30, 8)
    options = Options(30, method=method, seed=8)
    by_file, _ = sample_cloud(points.numpy(), sampler, 30, options, Path("map.las"))
    assert by_file is not None
    assert by_file.tolist() == rows.tolist()


@pytest.mark.parametrize("start", [None, 17, "farthest"])
@pytest.mark.parametrize("kind", ["sphere", "grid", "copies", "one point", "huge", "tiny"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_arrays_tensors_and_the_sampler_give_the_same_rows(start, kind, dtype, rng):
    points = cloud_of(kind, (2, 200), dtype, rng)
    array = points.numpy()
    sampler = FPSSampler(50, 5, start)
    settings: dict[str, Any] = {"seed": 5, "start": start}

    _, expected = sampler.downsample(points)
    kept, rows = downsample(points, 50, **settings)
    kept_of_array, rows_of_array = downsample(array, 50, **settings)
    _, rows_alone = downsample(array[1], 50, **settings)

    assert torch.equal(rows, expected)
    assert rows_of_array.tolist() == expected.tolist()
    assert rows_alone.tolist() == expected[1].tolist()
    assert torch.equal(kept, gather_points(points, rows))
    assert np.array_equal(kept_of_array, kept)


def test_exact_ties_of_the_given_coordinates_are_ties():
    steps = torch.arange(6, dtype=torch.float32)
    grid = torch.cartesian_prod(steps, steps, steps) + 1000

    _, rows = downsample(grid.double(), 60, seed=2)
    _, rows_of_half = downsample(grid.double() * 0.5, 60, seed=2)

    assert torch.equal(rows, rows_of_half)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("number", [float("nan"), float("inf")])
def test_coordinates_that_are_not_finite_are_refused(method, number):
    points = np.zeros((40, 3), np.float32)
    points[21, 2] = number

    with pytest.raises(Exception, match="points must be finite, got NaN or infinity"):
        downsample(points, 8, method)


def test_samplers_of_nets_get_the_unit_sphere(randn):
    class FirstPoints(Sampler):
        def sample(self, points, m):
            assert points.norm(dim=2).amax() <= 1 + 1e-6
            return RandomSampler(m)(points)

    points = randn(60, 3) * 1000

    _, rows = FirstPoints(6).downsample(points)

    in_double = points.double().numpy()
    sphere = UnitSphere.around(in_double).normalise(in_double)
    (expected,) = RandomSampler(6)(sphere[None]).indices
    assert torch.equal(rows, expected)
