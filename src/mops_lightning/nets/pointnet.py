"""PointNet for classification: vanilla, the paper's task net, and with transform nets.

Qi et al., "PointNet: Deep Learning on Point Sets for 3D Classification and Segmentation", CVPR
2017.
"""

import torch
from torch import Tensor, nn

from mops_lightning.channels import PointChannels, coordinates, with_coordinates
from mops_lightning.nets.layers import PointMLP, linear_norm_relu
from mops_lightning.nets.max_pool import PointMaxPool


def classifier_head(num_classes: int, dropout: float) -> nn.Sequential:
    """Return PointNet's layers from the pooled feature ``(B, 1024)`` to logits.

    Args:
        num_classes: number of logits.
        dropout: dropout probability before the last layer.
    """
    return nn.Sequential(
        *linear_norm_relu([1024, 512, 256]),
        nn.Dropout(dropout),
        nn.Linear(256, num_classes),
    )


class PointNetVanilla(nn.Module):
    """PointNet without transform nets (paper section "Classification-oriented Downsampling").

    Pointwise layers of 64, 64, 64, 128 and 1024 channels, maximum over points, then layers of 512,
    256 and ``num_classes``. Dropout follows the layer of 256. Accepts any number of points.

    Args:
        num_classes: number of logits.
        dropout: dropout probability.
        point_channels: channels of the points, or their number.
    """

    def __init__(
        self, num_classes: int, dropout: float = 0.3, point_channels: PointChannels | int = 0
    ) -> None:
        super().__init__()
        self.point_channels = PointChannels.of(point_channels)
        input_channels = 3 + len(self.point_channels)
        self.features = PointMLP([input_channels, 64, 64, 64, 128])
        self.pool = PointMaxPool(128, 1024)
        self.head = classifier_head(num_classes, dropout)

    def forward(self, points: Tensor) -> Tensor:
        """Map ``(B, N, 3 + C)`` points to ``(B, num_classes)`` logits."""
        return self.head(self.pool(self.features(points)))

    def point_features(self, points: Tensor) -> Tensor:
        """Return the features ``(B, N, 1024)`` before the maximum over points."""
        return self.pool.values(self.features(points))


class TransformNet(nn.Module):
    """Predicts a square matrix for every cloud, the identity before training.

    Args:
        size: number of rows of the matrix and channels of the input.
    """

    def __init__(self, size: int) -> None:
        super().__init__()
        self.features = PointMLP([size, 64, 128])
        self.pool = PointMaxPool(128, 1024)
        hidden = linear_norm_relu([1024, 512, 256])
        last = nn.Linear(256, size * size)
        self.head = nn.Sequential(*hidden, last)
        self.size = size
        nn.init.zeros_(last.weight)
        with torch.no_grad():
            last.bias.copy_(torch.eye(size).flatten())

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(B, N, size)`` to ``(B, size, size)``."""
        matrix = self.head(self.pool(self.features(features)))
        return matrix.unflatten(1, (self.size, self.size))


class PointNetTransform(nn.Module):
    """PointNet with transform nets for the points and for the features of 64 channels.

    The published loss also keeps the feature transform near a rotation (weight 0.001), which is
    left out. Accepts any number of points.

    Args:
        num_classes: number of logits.
        dropout: dropout probability.
        point_channels: channels of the points, or their number.
    """

    def __init__(
        self, num_classes: int, dropout: float = 0.3, point_channels: PointChannels | int = 0
    ) -> None:
        super().__init__()
        self.point_channels = PointChannels.of(point_channels)
        input_channels = 3 + len(self.point_channels)
        self.first = PointMLP([input_channels, 64, 64])
        self.point_transform = TransformNet(3)
        self.feature_transform = TransformNet(64)
        self.features = PointMLP([64, 64, 128])
        self.pool = PointMaxPool(128, 1024)
        self.head = classifier_head(num_classes, dropout)

    def forward(self, points: Tensor) -> Tensor:
        """Map ``(B, N, 3 + C)`` points to ``(B, num_classes)`` logits."""
        places = coordinates(points)
        turned = places @ self.point_transform(places)
        features = self.first(with_coordinates(points, turned))
        transform = self.feature_transform(features)
        features = features.to(transform.dtype) @ transform
        return self.head(self.pool(self.features(features)))
