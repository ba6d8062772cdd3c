"""Samplers that choose by normals: what they estimate, and which normals belong to which point."""

import numpy as np
import pytest
import torch

from mops_lightning import (
    CovarianceSampler,
    InformationSampler,
    NormalSpaceSampler,
    SteadySampler,
)
from mops_lightning.errors import UserError
from mops_lightning.ops.normals import estimate_normals
from mops_lightning.ops.stability import (
    informative_places,
    places_by_direction,
    plane_rows,
    stable_places,
    steady_places,
)
from mops_lightning.samplers.ordering import seeded_order
from tests.ops.test_stability import box

SAMPLERS = [
    CovarianceSampler,
    InformationSampler,
    NormalSpaceSampler,
]


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_rows_are_those_of_normals_estimated_from_so_many_neighbours(sampler):
    cloud = box(200)
    points = torch.from_numpy(cloud)[None]
    normals = torch.from_numpy(estimate_normals(cloud, 30))[None]
    by_30 = sampler(20, neighbours=30)

    estimated = by_30.rows(points, 20)
    given = by_30.rows(points, 20, normals)
    by_default = sampler(20).rows(points, 20)

    assert torch.equal(estimated, given)
    assert not torch.equal(by_default, estimated)


RULES = [
    (CovarianceSampler, stable_places),
    (InformationSampler, informative_places),
    (SteadySampler, lambda rows, m: steady_places(rows, np.ones(len(rows)), m)),
    (NormalSpaceSampler, lambda rows, m: places_by_direction(rows[:, 3:], m)),
]
"""Samplers, and how they choose by rows of ``plane_rows``."""


@pytest.mark.parametrize(("sampler", "rule"), RULES)
def test_samplers_choose_by_their_own_rules(sampler, rule):
    cloud = box(150)
    points = torch.from_numpy(cloud)[None]

    (chosen,) = sampler(20, seed=3)(points).indices.numpy()

    (order,) = seeded_order(points, 3).numpy()
    ordered = cloud[order]
    rows = plane_rows(ordered, estimate_normals(ordered))
    assert chosen.tolist() == order[rule(rows, 20)].tolist()


@pytest.mark.parametrize(("sampler", "rule"), RULES)
def test_planes_through_two_points_are_refused(sampler, rule):
    with pytest.raises(UserError, match="neighbours must be at least 3, got 2"):
        sampler(20, neighbours=2)
