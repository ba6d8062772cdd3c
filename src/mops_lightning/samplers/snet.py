"""S-Net, a baseline in the paper's tables: points generated from the global feature."""

from collections.abc import Sequence

from torch import Tensor, nn

from mops_lightning.channels import PointChannels
from mops_lightning.errors import check_at_least
from mops_lightning.losses.subset import simplification_losses
from mops_lightning.nets.layers import PointMLP, check_channels, linear_norm_relu
from mops_lightning.nets.max_pool import PointMaxPool
from mops_lightning.samplers.base import Sampler
from mops_lightning.types import SampleOutput


class SNet(Sampler):
    """S-Net: pointwise layers, maximum over points, and a head with all 3m coordinates as output.

    Dovrat, Lang and Avidan, "Learning to Sample", CVPR 2019.

    Args:
        m: number of points to generate.
        alpha: weight of the simplification loss in the training loss.
        coverage: γ of the simplification loss.
        coverage_per_point: δ of the simplification loss.
        feature_channels: sizes of the pointwise layers, each with BatchNorm and ReLU.
        head_channels: sizes of the head's hidden layers, each with ReLU.
        head_norm: whether the hidden layers have BatchNorm.
        output_norm: whether the output layer has BatchNorm.
        point_channels: channels of the points, or their number. Generated points have the channels
            of the nearest input points.

    Raises:
        UserError: an argument is out of range.

    Examples:
        >>> import torch
        >>> from mops_lightning import SNet
        >>> SNet(m=8).eval()(torch.rand(2, 64, 3)).points.shape  # (B, N, 3) to (B, m, 3)
        torch.Size([2, 8, 3])
    """

    generates = True

    def __init__(
        self,
        m: int,
        alpha: float = 30.0,
        coverage: float = 1.0,
        coverage_per_point: float = 0.0,
        feature_channels: Sequence[int] = (64, 64, 64, 128, 128),
        head_channels: Sequence[int] = (256, 256, 256),
        head_norm: bool = True,
        output_norm: bool = True,
        point_channels: PointChannels | int = 0,
    ) -> None:
        super().__init__(m)
        self.point_channels = PointChannels.of(point_channels)
        check_at_least(0, alpha=alpha, coverage=coverage, coverage_per_point=coverage_per_point)
        check_channels("feature_channels", feature_channels, 2)
        check_channels("head_channels", head_channels)
        self.alpha = alpha
        self.coverage = coverage
        self.coverage_per_point = coverage_per_point
        input_channels = 3 + len(self.point_channels)
        self.features = PointMLP([input_channels, *feature_channels[:-1]])
        self.pool = PointMaxPool(feature_channels[-2], feature_channels[-1])
        hidden = linear_norm_relu([feature_channels[-1], *head_channels], head_norm)
        layers: list[nn.Module] = list(hidden)
        layers.append(nn.Linear(head_channels[-1], 3 * m, bias=not output_norm))
        if output_norm:
            layers.append(nn.BatchNorm1d(3 * m))
        self.head = nn.Sequential(*layers)

    def sample(self, points: Tensor, m: int) -> SampleOutput:
        """Generate points; see ``Sampler.forward``."""
        of_cloud = self.pool(self.features(points))
        coordinates = self.head(of_cloud).unflatten(1, (self.m, 3))
        return SampleOutput(coordinates[:, :m], None, {})

    def losses(
        self, points: Tensor, output: SampleOutput, sizes: Sequence[int]
    ) -> dict[int, dict[str, Tensor]]:
        """Return α times the simplification loss at every size."""
        weights = (self.coverage, self.coverage_per_point)
        losses = simplification_losses(points, output.points, sizes, *weights)
        return {m: {"simplification": self.alpha * loss} for m, loss in losses.items()}
