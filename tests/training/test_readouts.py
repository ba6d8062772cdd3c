from typing import Any

import pytest
import torch

from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.training.readouts import names_of_readouts, readouts

SMALL: dict[str, Any] = {"feature_channels": (8, 8), "rho_channels": (16, 8)}


@pytest.mark.parametrize("sampler", [FPSSampler(8), MOPSNet(8, **SMALL)])
@torch.no_grad()
def test_readouts_refine_starts_from_distinct_rows(sampler, rng):
    points = torch.randn(3, 60, 3, generator=rng)
    started = {}

    def refine(rows):
        started.update(rows)
        return {m: 59 - one for m, one in rows.items()}

    outputs = sampler.eval().sample_sizes(points, (8,))
    samples = readouts(points, outputs, sampler, refine)[8]
    *names, last = samples
    assert last == "refined"
    assert torch.equal(gather_points(points, started[8]), samples[names[-1]])
    assert torch.equal(samples["refined"], gather_points(points, 59 - started[8]))


def test_readout_names_without_sampler_is_full():
    assert names_of_readouts(None) == ("full",)
