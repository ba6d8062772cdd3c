"""Greedy selection of the points that cover the task net's max-pooled features."""

from torch import Tensor

from mops_lightning.ops.facility_location import facility_location
from mops_lightning.samplers.task_net import TaskNetSampler


class SubmodularSampler(TaskNetSampler):
    """Choose points whose max-pooled features are nearly those of the full cloud, without training.

    With f_ic the feature c of point i, points are chosen greedily so that Σ_c max_i f_ic over the
    chosen points grows most (facility location, see ``ops.facility_location``). Once the
    maxima are those of the full cloud, farthest points follow. Flexible and nested.

    Args:
        m: largest number of points to return.
        net: the task net, see ``TaskNetSampler``.
        seed: breaks ties.

    Raises:
        UserError: ``net`` is missing or unsuitable.

    Examples:
        >>> import torch
        >>> from mops_lightning import SubmodularSampler
        >>> from mops_lightning.nets.pointnet import PointNetVanilla
        >>> net = PointNetVanilla(num_classes=40)
        >>> SubmodularSampler(m=8, net=net)(torch.rand(2, 64, 3)).indices.shape  # (B, m)
        torch.Size([2, 8])
    """

    def choose(self, features: Tensor, m: int) -> tuple[Tensor, Tensor]:
        """Choose points greedily; see ``TaskNetSampler.choose``."""
        return facility_location(features, m)
