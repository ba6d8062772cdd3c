"""Gumbel subset sampling, a learned selection of input points."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from mops_lightning.channels import PointChannels
from mops_lightning.errors import UserError
from mops_lightning.nets.layers import PointFeatures, PointMLP, check_channels
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.base import Sampler
from mops_lightning.types import SampleOutput

KEY_CHANNELS = (256, 128)
"""Sizes of the layers of the MLP on the local and the global feature."""


class GumbelSampler(Sampler):
    """Gumbel subset sampling: every sampled point is a learned random choice of an input point.

    Yang et al., "Modeling Point Clouds with Self-Attention and Gumbel Subset Sampling", CVPR 2019,
    section "Gumbel Subset Sampling". With features x_i of the points and a learned matrix W
    ``(m, C)``, training returns gumbel_softmax(W·Xᵀ)·P: softmax over the points of the scores plus
    Gumbel noise, divided by a temperature tau that decreases from 1 to ``tau_min``. Evaluation
    returns the point with the largest score, without noise. The same point may be chosen several
    times; the completed readout replaces repetitions.

    Differences from the publication: there, the layer is inside a classifier, samples the features
    of its attention blocks, and is trained with it; here, it selects input points for a task net,
    by its own features: pointwise layers, and an MLP of the local and the global feature.

    Args:
        m: number of points to choose.
        tau_min: temperature at the end of training; training starts at 1.
        feature_channels: sizes of the pointwise layers.
        point_channels: channels of the points, or their number.

    Raises:
        UserError: an argument is out of range.

    Examples:
        >>> import torch
        >>> from mops_lightning import GumbelSampler
        >>> GumbelSampler(m=8).eval()(torch.rand(2, 64, 3)).points.shape  # (B, m, 3)
        torch.Size([2, 8, 3])
    """

    generates = True

    def __init__(
        self,
        m: int,
        tau_min: float = 0.1,
        feature_channels: Sequence[int] = (64, 64, 64, 128, 128),
        point_channels: PointChannels | int = 0,
    ) -> None:
        super().__init__(m)
        self.point_channels = PointChannels.of(point_channels)
        if not 0 < tau_min <= 1:
            raise UserError(f"tau_min must be above 0 and at most 1, got {tau_min}.")
        check_channels("feature_channels", feature_channels)
        self.tau_min = tau_min
        self.training_tau = 1.0
        input_channels = 3 + len(self.point_channels)
        width = feature_channels[-1]
        self.features = PointFeatures(PointMLP([input_channels, *feature_channels]))
        self.keys = PointMLP([2 * width, *KEY_CHANNELS])
        self.queries = nn.Linear(KEY_CHANNELS[-1], m, bias=False)

    @property
    def tau(self) -> float:
        """The temperature of training; evaluation has none."""
        if self.training:
            return self.training_tau
        return self.tau_min

    def anneal(self, progress: float) -> None:
        """Set the temperature, exponentially from 1 to ``tau_min`` for a progress from 0 to 1."""
        share = min(max(progress, 0.0), 1.0)
        self.training_tau = self.tau_min**share

    def scores(self, points: Tensor) -> Tensor:
        """Return the scores ``(B, m, N)`` of ``(B, N, 3)`` points."""
        local, global_ = self.features(points)
        of_points = global_[:, None].expand_as(local)
        keys = self.keys(torch.cat([local, of_points], 2))
        return self.queries.weight @ keys.to(self.queries.weight).mT

    def sample(self, points: Tensor, m: int) -> SampleOutput:
        """Choose points; in training, return weighted means that approximate the choice."""
        scores = self.scores(points)
        if not self.training:
            chosen = gather_points(points, scores.argmax(2))
            return SampleOutput(chosen, None, {})
        noise = -torch.empty_like(scores).exponential_().log()  # of the Gumbel distribution
        weights = ((scores + noise) / self.tau).softmax(2)
        sampled = self.point_channels.renormalised(weights @ points)
        return SampleOutput(sampled, None, {})
