"""Samplers that choose by normals: what they estimate, and which normals belong to which point."""

import pytest
import torch

from mops_lightning import CovarianceSampler, InformationSampler, NormalSpaceSampler
from mops_lightning.ops.normals import estimate_normals
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
