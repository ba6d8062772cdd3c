"""Base of the samplers that select points by the features of a frozen task net."""

import torch
from torch import Tensor, nn

from mops_lightning.errors import UserError
from mops_lightning.ops.fps import farthest_point_fill
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.ordering import seeded_order
from mops_lightning.types import PointFeatureNet, SampleOutput

BATCH_POINTS = 32768
"""Number of points whose features are in memory together; at least one cloud."""


class TaskNetSampler(Sampler):
    """Base of samplers that rank points by the features of the task net before its max-pooling.

    Flexible and nested. There is nothing to train and there are no weights to save: the net is not
    part of the module, so ``parameters``, ``state_dict`` and ``to`` leave it out. A subclass
    implements ``choose``. Points that it does not rank follow in the order of farthest point
    sampling from those that it chose.

    Args:
        m: largest number of points to return.
        net: the task net; it is used in evaluation mode and without gradients.
        seed: breaks ties, as for ``FPSSampler``.

    Raises:
        UserError: ``net`` is missing, or has no features of single points under a maximum.
    """

    flexible = True
    nested = True

    def __init__(self, m: int, net: nn.Module | None = None, seed: int = 0) -> None:
        super().__init__(m)
        name = type(self).__name__
        if net is None:
            raise UserError(
                f"net must be the task net: {name} selects points by the net's features and has "
                f"no weights. In Python: {name}(m, net=task.net)."
            )
        if not isinstance(net, PointFeatureNet):
            raise UserError(
                f"net must have features of single points under a maximum (point_features), as "
                f"{name} needs them, got {type(net).__name__}. Choose another task net, such as "
                "pointnet, or another sampler."
            )
        self._net = (net,)  # in a tuple, torch does not register it as a submodule
        self.seed = seed

    @property
    def net(self) -> PointFeatureNet:
        """The task net."""
        net = self._net[0]
        assert isinstance(net, PointFeatureNet)
        return net

    def choose(self, features: Tensor, m: int) -> tuple[Tensor, Tensor]:
        """Choose points by the task net's features.

        Args:
            features: ``(B, N, C)``, non-negative.
            m: largest number of points to choose.

        Returns:
            ``(B, m)`` int64 rows in the order of choice, and ``(B,)`` int64 how many of them count,
            at least one.
        """
        raise NotImplementedError

    def sample(self, points: Tensor, m: int) -> SampleOutput:
        """Return m of the points ``(B, N, 3)`` with their indices, in the order of choice."""
        order = seeded_order(points, self.seed)
        ordered = gather_points(points.detach(), order)
        filled = farthest_point_fill(ordered, *self._chosen(ordered, m))
        indices = order.gather(1, filled)
        return SampleOutput(gather_points(points, indices), indices, {})

    @torch.no_grad()
    def _chosen(self, points: Tensor, m: int) -> tuple[Tensor, Tensor]:
        net = self._net[0]
        like = next(net.parameters(), points)
        modes = {module: module.training for module in net.modules()}
        batches = points.split(max(1, BATCH_POINTS // points.shape[1]))
        net.eval()
        try:
            parts = [self.choose(self.net.point_features(part.to(like)), m) for part in batches]
        finally:
            for module, mode in modes.items():
                module.training = mode
        rows, counts = zip(*parts, strict=True)
        return torch.cat(rows).to(points.device), torch.cat(counts).to(points.device)
