"""The best sampler for each number of points."""

import pytest
import torch

from mops_lightning import FMOPSNet, FPSSampler, MOPSNet, PoissonSampler, RandomSampler
from mops_lightning.errors import UserError
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.by_budget import MOST, ByBudget

FPS = FPSSampler(MOST)
RANDOM = RandomSampler(MOST)
POISSON = PoissonSampler(MOST)


@pytest.mark.parametrize(
    ("m", "expected"),
    [
        (3, RANDOM),  # below the first compared number: its method
        (8, RANDOM),
        (12, RANDOM),  # between two with the same method
        (16, RANDOM),
        (20, FPS),  # between two with different methods
        (32, POISSON),
        (40, FPS),  # between two with different methods
        (64, FPS),
        (65, FPS),  # above the last one
        (5000, FPS),
    ],
)
def test_by_budget_takes_the_method_of_the_number(m, expected):
    sampler = ByBudget([8, 16, 32, 64], [1, 1, 2, 0], [FPS, RANDOM, POISSON])

    assert sampler.sampler_for(m) is expected


def test_by_budget_takes_farthest_points_for_numbers_that_a_sampler_does_not_return():
    fixed = MOPSNet(m=8).eval()
    flexible = FMOPSNet(m_max=8).eval()

    of_fixed = ByBudget([8], [1], [FPS, fixed])
    of_flexible = ByBudget([8, 12], [1, 1], [FPS, flexible])

    assert of_fixed.sampler_for(8) is fixed
    assert of_fixed.sampler_for(7) is FPS
    assert of_flexible.sampler_for(7) is flexible
    assert of_flexible.sampler_for(8) is flexible
    assert of_flexible.sampler_for(10) is FPS


def test_by_budget_returns_the_completed_set_of_a_trained_sampler(rand):
    points = rand(2, 64, 3)
    trained = FMOPSNet(m_max=16).eval()
    sampler = ByBudget([8, 32], [1, 0], [FPS, trained]).eval()

    output = sampler(points, 8)
    farthest, farthest_rows = sampler.downsample(points, 32)

    expected, rows = trained.select("completed", points, 8)
    _, expected_farthest_rows = FPSSampler(32).downsample(points, 32)
    assert rows is not None
    assert output.indices.tolist() == rows.tolist()
    assert torch.equal(output.points, expected)
    assert torch.equal(farthest_rows, expected_farthest_rows)
    assert torch.equal(farthest, gather_points(points, farthest_rows))


def test_by_budget_shows_channels_to_the_samplers_that_take_them(rand):
    points = rand(2, 64, 5)
    trained = FMOPSNet(m_max=16, point_channels=2).eval()
    sampler = ByBudget([8, 16], [1, 0], [FPS, trained], point_channels=2).eval()

    rows = sampler(points, 8).indices
    farthest = sampler(points, 16)

    expected, _ = trained.select("completed", points, 8)
    expected_farthest = FPSSampler(16)(points)
    assert torch.equal(gather_points(points, rows), expected)
    assert torch.equal(farthest.points, expected_farthest.points)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (([8], [0], [RANDOM]), "begin with farthest"),
        (([8], [0], []), "begin with farthest"),
        (([], [], [FPS]), "ascending"),
        (([0, 8], [0, 0], [FPS]), "ascending"),
        (([16, 8], [0, 0], [FPS]), "ascending"),
        (([8, 8], [0, 0], [FPS]), "ascending"),
        (([8], [0, 0], [FPS]), "ascending"),
        (([8], [1], [FPS]), "positions"),
        (([8], [-1], [FPS]), "positions"),
    ],
)
def test_by_budget_refuses_arguments_that_do_not_fit(arguments, said):
    with pytest.raises(UserError, match=said):
        ByBudget(*arguments)
