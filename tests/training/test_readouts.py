import pytest
import torch

from mops_lightning.metrics.base import collection
from mops_lightning.metrics.classification import Accuracy
from mops_lightning.ops.points import gather_points
from mops_lightning.ops.readout import complete
from mops_lightning.training.readouts import readouts
from mops_lightning.training.scores import Scores
from tests.support.samplers import SAMPLERS


@pytest.mark.parametrize("name", ["mops", "fmops"])
@torch.no_grad()
def test_readouts_of_each_size_are_its_own_matches_completed(name, rng):
    sampler = SAMPLERS[name](8).eval()
    points = torch.randn(3, 60, 3, generator=rng)
    outputs = sampler.sample_sizes(points, (4, 8) if name == "fmops" else (8,))
    for m, samples in readouts(points, outputs, sampler).items():
        rows = torch.cdist(outputs[m].points, points).argmin(2)
        assert torch.equal(samples["generated"], outputs[m].points)
        assert torch.equal(samples["matched"], gather_points(points, rows))
        assert torch.equal(samples["completed"], gather_points(points, complete(rows, points)))


def test_scores_loss_of_nan_is_nan():
    made = Scores(lambda: collection(Accuracy(3)), ("generated",), ())
    assert made.update_loss("test/loss/x", torch.tensor(torch.nan), 2).compute().isnan()
