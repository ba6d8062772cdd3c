import torch

from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.tasks.classification import Classification


def test_disagreement_is_divergence_of_reference_from_prediction():
    """Kullback-Leibler divergences are not symmetric."""
    task = Classification(PointNetVanilla(2), 2)
    reference, found = torch.tensor([[0.9, 0.1]]), torch.tensor([[0.5, 0.5]])
    expected = 0.9 * torch.tensor(0.9 / 0.5).log() + 0.1 * torch.tensor(0.1 / 0.5).log()
    apart = task.disagreement(found.log(), reference.log() + 3)  # logits, up to a constant
    torch.testing.assert_close(apart, expected[None])
