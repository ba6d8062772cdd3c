import pytest
import torch

from mops_lightning.metrics.base import collection
from mops_lightning.metrics.classification import Accuracy
from mops_lightning.ops.points import gather_points
from mops_lightning.training.readouts import readouts
from mops_lightning.training.scores import Scores
from tests.support.samplers import SAMPLERS


@pytest.mark.parametrize("name", ["fps", "mops"])
@torch.no_grad()
def test_readouts_refine_starts_from_distinct_rows(name, rng):
    sampler = SAMPLERS[name](8)
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


def test_scores_loss_of_nan_is_nan():
    made = Scores(lambda: collection(Accuracy(3)), ("generated",), ())
    assert made.update_loss("test/loss/x", torch.tensor(torch.nan), 2).compute().isnan()
