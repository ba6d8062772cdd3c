"""CS-Net, a published sampler to compare with."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from mops_lightning.errors import check_at_least
from mops_lightning.nets.layers import PointMLP, check_channels
from mops_lightning.ops.maxima import max_of_rows
from mops_lightning.ops.nearest import k_nearest
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.base import Sampler
from mops_lightning.types import SampleOutput

from .selector import soft_top_k, straight_through


def soft_coverage(points: Tensor, logarithms: Tensor, width: float) -> Tensor:
    """Return the mean squared distance of all points to a soft selection of them.

    The distance of point p to the selection is the soft minimum −w·log Σ_i a_i·exp(−‖p − p_i‖²/w)
    over all points i with their degrees of selection a_i, so that every score gets a gradient.

    Args:
        points: ``(B, N, 3)``.
        logarithms: ``(B, N)`` log a_i.
        width: w, in squared units of the coordinates.
    """
    logits = logarithms[:, None] - torch.cdist(points, points).square() / width
    return -width * logits.logsumexp(2).mean()


class OffsetAttention(nn.Module):
    """Features plus a layer of their offset from their attention over the cloud.

    Args:
        channels: channels of input and output.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.projections = nn.Linear(channels, 3 * channels, bias=False)
        self.offset = PointMLP([channels, channels])

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(B, N, C)`` to ``(B, N, C)``."""
        # With an axis of heads, torch takes its fast path.
        queries, keys, values = self.projections(features)[:, None].chunk(3, 3)
        attended = nn.functional.scaled_dot_product_attention(queries, keys, values)
        return features + self.offset(features - attended[:, 0]).to(features)


class CSNet(Sampler):
    """CS-Net: the input points with the largest contribution scores.

    Guo et al., "CS-Net: Contribution-based Sampling Network for Point Cloud Simplification", 2025.
    Every point gets a score from pointwise layers with a maximum over its neighbours, a cascade of
    three offset attentions, and an MLP. The points with the m largest scores are selected; the
    gradient is that of a top-k relaxed by entropic optimal transport.

    Differences from the publication: in training, a selected point has the gradient of the mean of
    its nearest points, weighted by their degrees of selection, so that the score of a point rises
    when it would be the better choice. The sampling loss is ``soft_coverage``.

    Args:
        m: number of points to select.
        alpha: weight of the sampling loss.
        epsilon: weight of the entropy of the transport, for scores of deviation 1 in each cloud.
        width: width of the soft minimum in the sampling loss, in squared units of the coordinates.
        k: number of neighbours, in the features and in the gradient.
        channels: channels of the attention.
        feature_channels: sizes of the pointwise layers.

    Raises:
        UserError: an argument is out of range.
    """

    def __init__(
        self,
        m: int,
        alpha: float = 30.0,
        epsilon: float = 0.5,
        width: float = 0.02,
        k: int = 16,
        channels: int = 64,
        feature_channels: Sequence[int] = (64, 64, 64),
    ) -> None:
        super().__init__(m)
        check_at_least(0, alpha=alpha)
        check_at_least(1e-3, epsilon=epsilon, width=width)
        check_at_least(1, k=k, channels=channels)
        check_channels("feature_channels", feature_channels)
        self.alpha = alpha
        self.epsilon = epsilon
        self.width = width
        self.k = k
        self.features = PointMLP([3, *feature_channels])
        self.embedding = PointMLP([2 * feature_channels[-1], channels])
        self.attention = nn.ModuleList(OffsetAttention(channels) for _ in range(3))
        self.scoring = PointMLP([4 * channels, 2 * channels, channels])
        self.last = nn.Linear(channels, 1, bias=False)

    def scores(self, points: Tensor) -> Tensor:
        """Return the scores ``(B, N)`` of ``(B, N, 3)`` points, normalised in each cloud."""
        local = self.features(points).to(points)
        near = k_nearest(points.detach(), points.detach(), min(self.k, points.shape[1]))[1]
        features = self.embedding(torch.cat([local, local - max_of_rows(local, near)], 2))
        stages = [features.to(points)]
        for attention in self.attention:
            stages.append(attention(stages[-1]))
        raw = self.last(self.scoring(torch.cat(stages, 2)).to(points))[..., 0]
        centred = raw - raw.mean(1, keepdim=True)
        return centred / (centred.square().mean(1, keepdim=True) + 1e-6).sqrt()

    def sample(self, points: Tensor, m: int) -> SampleOutput:
        """Select points; in training, add their soft projection and the sampling loss."""
        scores = self.scores(points)
        rows = scores.topk(m).indices
        chosen = gather_points(points, rows)
        if not self.training:
            return SampleOutput(chosen, rows, {})
        degrees = soft_top_k(scores, m, self.epsilon).clamp(min=1e-6).log()
        distances, near = k_nearest(chosen.detach(), points.detach(), self.k)
        logits = degrees.gather(1, near.flatten(1)).view_as(near)
        weights = (logits - distances / distances.mean(2, keepdim=True)).softmax(2)
        mean = (weights[..., None] * gather_points(points, near)).sum(2)
        sampling = {"coverage": self.alpha * soft_coverage(points, degrees, self.width)}
        return SampleOutput(chosen, rows, sampling, soft_projected=straight_through(chosen, mean))

    def losses(
        self, points: Tensor, output: SampleOutput, sizes: Sequence[int]
    ) -> dict[int, dict[str, Tensor]]:
        """Return α times the distance of the cloud to the soft selection."""
        return dict.fromkeys(sizes, output.losses)
