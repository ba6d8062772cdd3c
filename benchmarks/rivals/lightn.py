"""The self-correlation of LighTN, a published sampler, in MOPS-Net."""

from collections.abc import Sequence
from typing import Any

from torch import Tensor, nn

from mops_lightning.errors import check_at_least
from mops_lightning.losses.subset import simplification_losses
from mops_lightning.nets.layers import PointFeatures, PointMLP
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.types import SampleOutput


def self_correlation(features: Tensor) -> Tensor:
    """Return softmax(X·Xᵀ/√C)·X of features ``(B, N, C)``: attention without projections."""
    scale = features.shape[2] ** -0.5
    return ((scale * features) @ features.mT).softmax(2) @ features


class SelfCorrelatedMLP(PointMLP):
    """Pointwise layers, then self-correlation and a feed-forward net, each added to its input.

    Args:
        channels: 3, then the sizes of the pointwise layers.
        expansion: width of the feed-forward net's hidden layer over that of its input.
    """

    def __init__(self, channels: Sequence[int], expansion: int) -> None:
        super().__init__(channels)
        width = channels[-1]
        self.norm = nn.BatchNorm1d(width)
        self.feed_forward = PointMLP([width, expansion * width, width])

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(B, N, 3)`` points to local features ``(B, N, C)``."""
        embedded = super().forward(features).to(features)
        correlated = embedded + self_correlation(embedded)
        normalised = self.norm(correlated.flatten(0, 1)).view_as(embedded)
        return normalised + self.feed_forward(normalised).to(features)


class LighTN(MOPSNet):
    """LighTN: points generated from self-correlated features.

    Wang et al., "LighTN: Light-weight Transformer Network for Performance-overhead Tradeoff in
    Point Cloud Downsampling", 2022. Its attention is a single head without the three learned
    projections, softmax(X·Xᵀ/√C)·X, followed by a feed-forward net that expands and reduces the
    channels. Its loss asks for coverage of the cloud, too.

    Differences from the publication: the points are weighted means of the cloud by MOPS-Net's
    sampling matrix, whose local features are replaced by the self-correlated ones; the loss is the
    simplification loss.

    Args:
        m: number of points to generate.
        alpha: weight of the simplification loss.
        coverage: weight γ of the cloud's distance to the sample within it.
        expansion: width of the feed-forward net's hidden layer over that of its input.
        **settings: arguments of ``MOPSNet``.

    Raises:
        UserError: an argument is out of range.
    """

    def __init__(
        self,
        m: int,
        alpha: float = 30.0,
        coverage: float = 1.0,
        expansion: int = 2,
        feature_channels: Sequence[int] = (64, 64, 64, 128, 128),
        **settings: Any,
    ) -> None:
        super().__init__(m, alpha, feature_channels=feature_channels, **settings)
        check_at_least(0, coverage=coverage)
        check_at_least(1, expansion=expansion)
        self.streams = self.pointwise = False  # every point is correlated with all others
        self.coverage = coverage
        self.features = PointFeatures(SelfCorrelatedMLP([3, *feature_channels], expansion))

    def losses(
        self, points: Tensor, output: SampleOutput, sizes: Sequence[int]
    ) -> dict[int, dict[str, Tensor]]:
        """Return α times the simplification loss at every size."""
        losses = simplification_losses(points, output.points, sizes, self.coverage)
        return {m: {"simplification": self.alpha * loss} for m, loss in losses.items()}
