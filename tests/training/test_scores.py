import torch

from mops_lightning.metrics.base import collection
from mops_lightning.metrics.classification import Accuracy
from mops_lightning.training.scores import Scores


def test_scores_loss_of_nan_is_nan():
    metric = Scores(lambda: collection(Accuracy(3)), ("generated",), ()).update_loss(
        "test/loss/x", torch.tensor(torch.nan), 2
    )
    assert metric.compute().isnan()
