"""Critical points: the points that win the task net's max-pooling."""

from typing import Any

import torch
from torch import Tensor, nn

from mops_lightning.channels import PointChannels, coordinates
from mops_lightning.errors import UserError
from mops_lightning.ops.fps import farthest_point_fill
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.ordering import seeded_order
from mops_lightning.types import PointFeatureNet, SampleOutput

BATCH_POINTS = 32768
"""Number of points whose features are in memory together; at least one cloud."""


class CriticalSampler(Sampler):
    """Choose the points that contribute most to the task net's max-pooled features.

    Nezhadarya et al., "Adaptive Hierarchical Down-Sampling for Point Cloud Classification", CVPR
    2020, section "Critical Points Layer". A point is critical if it has the largest value in at
    least one channel; its contribution is the sum of the values in these channels. Points are
    chosen in descending order of their contribution. Flexible and nested.

    There is nothing to train and there are no weights to save: the net is not part of the module,
    so ``parameters``, ``state_dict`` and ``to`` leave it out.

    Differences from the publication: there, the layer is inside a classifier that is trained with
    it, and works on that classifier's intermediate features, as ``by_features`` does in a
    hierarchical net; alone, it selects input points by the features of a task net that was trained
    without it. Where a cloud has fewer than m critical points, the publication repeats points;
    here, farthest points follow.

    Args:
        m: largest number of points to return.
        net: the task net; it is used in evaluation mode and without gradients. Inside a net, None.
        seed: breaks ties, as for ``FPSSampler``.

    Raises:
        UserError: ``net`` is missing in a call, or has no features of points under a maximum.

    Examples:
        >>> import torch
        >>> from mops_lightning import CriticalSampler
        >>> from mops_lightning.nets.pointnet import PointNetVanilla
        >>> net = PointNetVanilla(num_classes=40)
        >>> CriticalSampler(m=8, net=net)(torch.rand(2, 64, 3)).indices.shape  # (B, m)
        torch.Size([2, 8])
    """

    flexible = True
    nested = True

    def __init__(self, m: int, net: nn.Module | None = None, seed: int = 0) -> None:
        super().__init__(m)
        self.point_channels = PointChannels.of(getattr(net, "point_channels", 0))
        if not isinstance(net, PointFeatureNet | None):
            raise UserError(
                "net must have features of single points under a maximum (point_features), as "
                f"CriticalSampler needs them, got {type(net).__name__}. Choose another sampler; "
                "PointNet, PCRNet and the auto-encoder have them, no segmentation net has."
            )
        self._net = (net,)  # in a tuple, torch does not register it as a submodule
        self.seed = seed

    def sample(self, points: Tensor, m: int) -> SampleOutput:
        """Return m of the points ``(B, N, 3)`` with their indices, in the order of choice."""
        order = seeded_order(coordinates(points), self.seed)
        ordered = gather_points(points.detach(), order)
        rows, counts = self._chosen(ordered, m)
        return _filled(points, order, rows, counts)

    def by_features(self, points: Tensor, features: Tensor, m: int) -> SampleOutput:
        """Choose by non-negative features ``(B, N, C)`` that the points have inside a net."""
        order = seeded_order(points, self.seed)
        ordered = gather_points(features, order)
        rows, counts = critical_points(ordered, m)
        return _filled(points, order, rows, counts)

    @torch.no_grad()
    def _chosen(self, points: Tensor, m: int) -> tuple[Tensor, Tensor]:
        net: Any = self._net[0]
        if net is None:
            raise UserError(
                "net must be the task net: CriticalSampler selects points by the net's features "
                "and has no weights. In Python: CriticalSampler(m, net=task.net)."
            )
        like = next(net.parameters(), points)
        modes = {module: module.training for module in net.modules()}
        clouds_at_once = max(1, BATCH_POINTS // points.shape[1])
        all_rows = []
        all_counts = []
        net.eval()
        try:
            for batch in points.split(clouds_at_once):
                features = net.point_features(batch.to(like))
                rows, counts = critical_points(features, m)
                all_rows.append(rows)
                all_counts.append(counts)
        finally:
            for module, mode in modes.items():
                module.training = mode
        return torch.cat(all_rows).to(points.device), torch.cat(all_counts).to(points.device)


def _filled(points: Tensor, order: Tensor, rows: Tensor, counts: Tensor) -> SampleOutput:
    """Return the points in the first ``counts`` rows, then farthest points."""
    places = coordinates(points.detach())
    ordered = gather_points(places, order)
    filled = farthest_point_fill(ordered, rows, counts)
    indices = order.gather(1, filled)
    return SampleOutput(gather_points(points, indices), indices, {})


@torch.no_grad()
def critical_points(features: Tensor, m: int) -> tuple[Tensor, Tensor]:
    """Choose the points with the largest contributions to the maxima of the channels.

    Args:
        features: ``(B, N, C)``, non-negative.
        m: largest number of points to choose.

    Returns:
        ``(B, m)`` int64 rows in the order of choice, and ``(B,)`` int64 how many of them count,
        at least one.
    """
    largest, winners = features.max(1)
    contribution = torch.zeros_like(features[..., 0])
    contribution = contribution.scatter_add_(1, winners, largest)
    order = contribution.argsort(dim=1, descending=True, stable=True)
    counts = (contribution > 0).sum(1)
    return order[:, :m], counts.clamp(1, m)
