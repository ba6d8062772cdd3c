"""A learned choice of points that hold a pose, for registration."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from mops_lightning.errors import UserError
from mops_lightning.nets.layers import PointMLP, check_channels, linear_norm_relu
from mops_lightning.ops.neighbourhoods import FEATURES, describe_neighbourhoods
from mops_lightning.ops.points import gather_points
from mops_lightning.ops.stability import plane_rows, steady_places
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.ordering import seeded_order
from mops_lightning.types import SampleOutput

TRAINED_SIZE = 32
"""Points of a sample in training, which the loss of this sampler does not depend on."""

LARGEST = 15.0
"""Limit of the logarithms of residuals, so that their squares stay finite."""


class PoseSampler(Sampler):
    """Choose points from which a registration is expected to err least.

    A net predicts for every point how large its residual will be, the distance to the plane of the
    corresponding point of another scan: large at borders, in vegetation, at thin parts and where
    few points were measured. It sees numbers that describe the neighbourhood of a point
    (``ops.neighbourhoods``), and their mean and maximum over the cloud. Points are then chosen one
    by one so that the error of the rotation, which follows from residuals and normals, is smallest
    (``ops.stability.steady_places``).

    The net is trained by ``task=icp`` on two halves of one scan, without labels. Untrained, it
    predicts nothing useful. Flexible and nested. Sampling runs on the CPU.

    Args:
        m_max: largest number of points to return.
        feature_channels: sizes of the pointwise layers.
        head_channels: sizes of the hidden layers after the mean and the maximum over the cloud.
        seed: of the order of the points (see ``ordering``), which breaks ties.

    Raises:
        UserError: an argument is out of range.

    Examples:
        >>> import torch
        >>> from mops_lightning import PoseSampler
        >>> output = PoseSampler(m_max=8).eval()(torch.rand(2, 64, 3))  # (B, N, 3)
        >>> output.points.shape, output.indices.shape, output.log_residuals.shape  # (B, N)
        (torch.Size([2, 8, 3]), torch.Size([2, 8]), torch.Size([2, 64]))
    """

    flexible = True
    nested = True
    spreads = False
    predicts_residuals = True

    def __init__(
        self,
        m_max: int = 512,
        feature_channels: Sequence[int] = (64, 64),
        head_channels: Sequence[int] = (64,),
        seed: int = 0,
    ) -> None:
        super().__init__(m_max)
        check_channels("feature_channels", feature_channels)
        check_channels("head_channels", head_channels)
        if isinstance(seed, bool) or not isinstance(seed, int):
            raise UserError(f"seed must be a whole number, got {seed!r}.")
        self.seed = seed
        local = feature_channels[-1]
        self.features = PointMLP([FEATURES, *feature_channels])
        self.head = linear_norm_relu([3 * local, *head_channels])
        self.last = nn.Linear(head_channels[-1], 1)

    def training_sizes(self) -> tuple[int, ...]:
        """Return one size, the same in every step."""
        return (min(TRAINED_SIZE, self.m),)

    def sample(self, points: Tensor, m: int) -> SampleOutput:
        """Return m of the points ``(B, N, 3)`` with their indices, in the order of choice."""
        order = seeded_order(points, self.seed)
        ordered = gather_points(points.detach(), order)
        clouds = ordered.double().cpu().numpy()
        surroundings = [describe_neighbourhoods(cloud) for cloud in clouds]
        feature_arrays = np.stack([surrounding.features for surrounding in surroundings])
        features = torch.from_numpy(feature_arrays)
        predicted = self.log_residuals(features.to(self.last.weight))
        spreads = predicted.detach().double().exp().cpu().numpy()
        places = []
        for cloud, surrounding, spread in zip(clouds, surroundings, spreads, strict=True):
            rows = plane_rows(cloud, surrounding.normals)
            places.append(steady_places(rows, spread, m))
        chosen = torch.from_numpy(np.stack(places)).to(order)
        indices = order.gather(1, chosen)
        back = torch.empty_like(order).scatter_(1, order, _ranks(order))
        return SampleOutput(
            gather_points(points, indices), indices, {}, log_residuals=predicted.gather(1, back)
        )

    def log_residuals(self, features: Tensor) -> Tensor:
        """Return the logarithms ``(B, N)`` of the residuals from features ``(B, N, FEATURES)``."""
        local = self.features(features).to(self.last.weight)  # half precision in autocast
        of_cloud = torch.cat([local.mean(1), local.amax(1)], 1)
        of_points = of_cloud[:, None].expand(-1, local.shape[1], -1)
        both = torch.cat([local, of_points], 2)
        hidden = self.head(both.flatten(0, 1))
        residuals = self.last(hidden)[:, 0]
        clamped = residuals.clamp(-LARGEST, LARGEST)
        return clamped.unflatten(0, features.shape[:2])


def _ranks(order: Tensor) -> Tensor:
    ranks = torch.arange(order.shape[1], device=order.device)
    return ranks.expand_as(order)
