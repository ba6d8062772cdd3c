"""PointNet vanilla, the task net for classification.

Qi et al., "PointNet: Deep Learning on Point Sets for 3D Classification and Segmentation", CVPR
2017.
"""

from torch import Tensor, nn

from mops_lightning.nets.layers import PointMLP, linear_norm_relu
from mops_lightning.nets.max_pool import PointMaxPool


class PointNetVanilla(nn.Module):
    """PointNet without transform nets (paper section "Classification-oriented Downsampling").

    Pointwise layers of 64, 64, 64, 128 and 1024 channels, maximum over points, then layers of 512,
    256 and ``num_classes``. Dropout follows the layer of 256. Accepts any number of points.

    Args:
        num_classes: number of logits.
        dropout: dropout probability.
    """

    def __init__(self, num_classes: int, dropout: float = 0.3) -> None:
        super().__init__()
        self.features = PointMLP([3, 64, 64, 64, 128])
        self.pool = PointMaxPool(128, 1024)
        self.head = nn.Sequential(
            *linear_norm_relu([1024, 512, 256]), nn.Dropout(dropout), nn.Linear(256, num_classes)
        )

    def forward(self, points: Tensor) -> Tensor:
        """Map ``(B, N, 3)`` points to ``(B, num_classes)`` logits."""
        return self.head(self.pool(self.features(points)))

    def point_features(self, points: Tensor) -> Tensor:
        """Return the features ``(B, N, 1024)`` of which the net takes the maximum over points."""
        return self.pool.values(self.features(points))

    def from_pooled(self, pooled: Tensor) -> Tensor:
        """Map the maxima ``(B, 1024)`` to logits."""
        return self.head(pooled)
