import pytest
import torch

from mops_lightning.metrics.base import collection
from mops_lightning.metrics.classification import Accuracy
from mops_lightning.training.scores import Scores


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
