"""Critical points: the points that win the task net's max-pooling."""

import torch
from torch import Tensor

from mops_lightning.samplers.task_net import TaskNetSampler


class CriticalSampler(TaskNetSampler):
    """Choose the points that contribute most to the task net's max-pooled features.

    Nezhadarya et al., "Adaptive Hierarchical Down-Sampling for Point Cloud Classification", CVPR
    2020, section "Critical Points Layer". A point is critical if it has the largest value in at
    least one channel; its contribution is the sum of the values in these channels. Points are
    chosen in descending order of their contribution. Flexible and nested.

    Differences from the publication: there, the layer is inside a classifier that is trained with
    it, and works on that classifier's intermediate features; here, it selects input points by the
    features of a task net that was trained without it. Where a cloud has fewer than m critical
    points, the publication repeats points; here, farthest points follow.

    Args:
        m: largest number of points to return.
        net: the task net, see ``TaskNetSampler``.
        seed: breaks ties.

    Raises:
        UserError: ``net`` is missing or unsuitable.

    Examples:
        >>> import torch
        >>> from mops_lightning import CriticalSampler
        >>> from mops_lightning.nets.pointnet import PointNetVanilla
        >>> net = PointNetVanilla(num_classes=40)
        >>> CriticalSampler(m=8, net=net)(torch.rand(2, 64, 3)).indices.shape  # (B, m)
        torch.Size([2, 8])
    """

    def choose(self, features: Tensor, m: int) -> tuple[Tensor, Tensor]:
        """Choose the points with the largest contributions; see ``TaskNetSampler.choose``."""
        largest, winners = features.max(1)
        contribution = torch.zeros_like(features[..., 0]).scatter_add_(1, winners, largest)
        order = contribution.argsort(dim=1, descending=True, stable=True)
        return order[:, :m], (contribution > 0).sum(1).clamp(1, m)
