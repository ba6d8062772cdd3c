import pytest
import torch

from mops_lightning.metrics.base import collection
from mops_lightning.metrics.classification import Accuracy
from mops_lightning.training.scores import Scores
from mops_lightning.types import SampleOutput, TaskOutput


def scores(prefixes=()):
    return Scores(lambda: collection(Accuracy(3)), ("generated", "matched"), prefixes)


def test_scores_loss_uneven_batches_is_mean_over_clouds():
    made = scores()
    made.update_loss("test/loss/x", torch.tensor(1.0), 8)
    metric = made.update_loss("test/loss/x", torch.tensor(4.0), 4)
    assert float(metric.compute()) == pytest.approx((8 * 1.0 + 4 * 4.0) / 12)


def test_scores_loss_of_nan_is_nan():
    metric = scores().update_loss("test/loss/x", torch.tensor(torch.nan), 2)
    assert metric.compute().isnan()


def test_scores_readouts_are_kept_apart():
    made = scores(("m8/",))
    labels = torch.tensor([0, 1, 2, 0])
    right, wrong = torch.eye(3)[labels], torch.eye(3)[(labels + 1) % 3]
    made.update_readout("m8/generated", TaskOutput({}, right, labels))
    made.update_readout("m8/matched", TaskOutput({}, wrong, labels))
    found = {**made.update_readout("generated", TaskOutput({}, wrong, labels))}
    assert list(found) == ["generated/accuracy"]
    assert [
        float(made.readouts[key].compute()["accuracy"])
        for key in ("m8/generated", "m8/matched", "generated")
    ] == [1.0, 0.0, 0.0]


def test_scores_sets_nested_measure_first_points(rng):
    points = torch.randn(2, 20, 3, generator=rng)
    # The first four samples are input points, the others are far away.
    samples = torch.cat([points[:, :4], points[:, :4] + 10], 1)
    whole = SampleOutput(samples, None, {})
    outputs = {8: whole, 4: whole.first(4)}
    found = scores(("m8/", "m4/")).update_sets(points, outputs, True, {8: "m8/", 4: "m4/"})
    assert float(found["m4/generated/subset_distance"].compute()) == 0
    assert float(found["m8/generated/subset_distance"].compute()) > 1


def test_scores_sets_not_nested_measure_each_size(rng):
    points = torch.randn(2, 20, 3, generator=rng)
    outputs = {
        8: SampleOutput(points[:, :8] + 10, None, {}),
        4: SampleOutput(points[:, :4], None, {}),
    }
    found = scores(("m8/", "m4/")).update_sets(points, outputs, False, {8: "m8/", 4: "m4/"})
    assert float(found["m4/generated/subset_distance"].compute()) == 0
    assert float(found["m8/generated/subset_distance"].compute()) > 1
