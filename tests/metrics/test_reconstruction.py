from typing import Any

import pytest
import torch

from mops_lightning.metrics import reconstruction
from mops_lightning.metrics.reconstruction import Distances

FOUND: Any = Distances(torch.tensor([2.0, 3.0, 0.0]), torch.tensor([1.0, 1.0, 0.0]))
FULL: Any = Distances(torch.tensor([1.0, 6.0, 0.0]), torch.tensor([0.5, 1.0, 0.0]))


@pytest.mark.parametrize(
    ("metric", "value"),
    [
        (reconstruction.MeanChamfer, 5 / 3),
        (reconstruction.MeanEMD, 2 / 3),
        (reconstruction.NormalizedChamfer, (2 + 0.5 + 1) / 3),
        (reconstruction.NormalizedEMD, (2 + 1 + 1) / 3),
        (reconstruction.NormalizedChamferOfMeans, 5 / 7),
        (reconstruction.NormalizedEMDOfMeans, 2 / 1.5),
    ],
)
def test_metric_over_batches_matches_hand_computed_value(metric, value):
    module = metric()
    for part in (slice(0, 1), slice(1, 3)):
        module.update(*(Distances(one.chamfer[part], one.emd[part]) for one in (FOUND, FULL)))
    assert module.compute().item() == pytest.approx(value)
