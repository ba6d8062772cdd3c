from typing import Any

import pytest
import torch

from mops_lightning.ops.points import gather_points
from mops_lightning.ops.readout import complete, match
from mops_lightning.samplers.fmops import FMOPSNet
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.training.readouts import readout_names, readouts

SMALL: dict[str, Any] = {"feature_channels": (8, 8), "rho_channels": (16, 8)}


@pytest.mark.parametrize(
    ("sampler", "sizes"),
    [
        (MOPSNet(8, **SMALL), (8,)),
        (FMOPSNet(16, **SMALL), (4, 16, 9)),
    ],
)
@torch.no_grad()
def test_readouts_generating_sampler_matches_and_completes_every_size(sampler, sizes, rng):
    points = torch.randn(3, 60, 3, generator=rng)
    sampler.eval()
    found = readouts(points, sampler.sample_sizes(points, sizes), sampler)
    assert tuple(found) == sizes
    for m, samples in found.items():
        assert tuple(samples) == readout_names(sampler) == ("generated", "matched", "completed")
        generated = samples["generated"]
        # Products of other shapes are rounded differently on some processors.
        torch.testing.assert_close(generated, sampler(points, m).points)
        matched = match(generated, points)
        assert torch.equal(samples["matched"], gather_points(points, matched))
        assert torch.equal(samples["completed"], gather_points(points, complete(matched, points)))


def test_readouts_index_sampler_has_sampled_only(rng):
    points, sampler = torch.randn(3, 60, 3, generator=rng), FPSSampler(8)
    found = readouts(points, sampler.sample_sizes(points, (4, 8)), sampler)
    assert {m: tuple(samples) for m, samples in found.items()} == {4: ("sampled",), 8: ("sampled",)}
    for m, samples in found.items():
        assert torch.equal(samples["sampled"], sampler(points, m).points)


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
    assert readout_names(None) == ("full",)
