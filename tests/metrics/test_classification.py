import pytest
import torch
from torch.nn import functional as F

from mops_lightning.metrics.classification import Accuracy, MeanClassAccuracy


def test_accuracy_over_batches_matches_hand_computed_value():
    labels = torch.tensor([0, 0, 0, 1, 2, 2])
    answers = torch.tensor([0, 0, 1, 1, 2, 0])
    logits = F.one_hot(answers, 3).float()
    metrics = Accuracy(3), MeanClassAccuracy(3)
    for metric in metrics:
        metric.update(logits[:2], labels[:2])
        metric.update(logits[2:], labels[2:])
    accuracy, mean_class = (metric.compute().item() for metric in metrics)
    assert accuracy == pytest.approx(4 / 6)
    assert mean_class == pytest.approx((2 / 3 + 1 + 1 / 2) / 3)
