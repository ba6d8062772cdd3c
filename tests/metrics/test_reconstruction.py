import pytest
import torch

from mops_lightning.metrics import reconstruction
from mops_lightning.metrics.reconstruction import Distances

CHAMFER = torch.tensor([2.0, 3.0, 0.0])
CHAMFER_OF_FULL = torch.tensor([1.0, 6.0, 0.0])
EMD = torch.tensor([1.0, 1.0, 0.0])
EMD_OF_FULL = torch.tensor([0.5, 1.0, 0.0])
FIRST_BATCH = slice(0, 1)
SECOND_BATCH = slice(1, 3)


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

    for batch in (FIRST_BATCH, SECOND_BATCH):
        found = Distances(CHAMFER[batch], EMD[batch])
        full = Distances(CHAMFER_OF_FULL[batch], EMD_OF_FULL[batch])
        module.update(found, full)

    assert module.compute().item() == pytest.approx(value)


def chamfer_distances(*values):
    return Distances(torch.tensor(values), None)


def test_error_of_a_cloud_that_the_net_rebuilds_exactly_from_all_points_only_is_infinite():
    module = reconstruction.NormalizedChamfer()

    module.update(chamfer_distances(2.0), chamfer_distances(0.0))

    assert module.compute() == torch.inf


def test_small_distances_after_a_large_one_are_not_lost():
    module = reconstruction.NormalizedChamferOfMeans()
    large = 2.0**25

    module.update(chamfer_distances(large), chamfer_distances(large))
    for _ in range(64):
        module.update(chamfer_distances(1.0), chamfer_distances(0.0))

    assert module.compute().item() == 1 + 64 / large
