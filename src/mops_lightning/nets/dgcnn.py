"""DGCNN, a classifier that looks at neighbourhoods; it shares no layer with PointNet.

Wang et al., "Dynamic Graph CNN for Learning on Point Clouds", ACM Transactions on Graphics 2019.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mops_lightning.channels import PointChannels, coordinates
from mops_lightning.errors import check_at_least
from mops_lightning.nets.layers import check_channels
from mops_lightning.nets.max_pool import PointMaxPool
from mops_lightning.nets.pointnet import classifier_head
from mops_lightning.ops.maxima import max_of_rows
from mops_lightning.ops.nearest import nearest_features


class EdgeConv(nn.Module):
    """The edge convolution of DGCNN with one linear layer.

    The published form is y_i = max_j relu(BN(A·x_i + B·(x_j − x_i))) over the k nearest points j
    in the space of x. As the layer is linear, only B·x_j depends on j. Here BatchNorm follows the
    maximum, so that no tensor of all edges is normalized.

    Args:
        channels_in: channels of x.
        channels_out: channels of y.
        k: number of neighbours, the point itself included; all points if there are fewer.
    """

    def __init__(self, channels_in: int, channels_out: int, k: int) -> None:
        super().__init__()
        self.k = k
        self.own = nn.Linear(channels_in, channels_out, bias=False)
        self.edge = nn.Linear(channels_in, channels_out, bias=False)
        self.norm = nn.BatchNorm1d(channels_out)

    def forward(self, features: Tensor, places: Tensor) -> Tensor:
        """Map ``(B, N, channels_in)`` to ``(B, N, channels_out)``.

        Args:
            features: x.
            places: ``(B, N, D)``, by whose distances neighbours are found; x in the publication.
        """
        n = features.shape[1]
        rows = nearest_features(places, self.k)
        edges = self.edge(features)
        mixed = self.own(features) - edges + max_of_rows(edges, rows)
        rows_of_all = mixed.flatten(0, 1)
        return F.relu(self.norm(rows_of_all)).unflatten(0, (-1, n))


class DGCNN(nn.Module):
    """Edge convolutions, a layer of 1024 channels on all their outputs, maximum, and a head.

    Smaller than published (three edge convolutions instead of four, one pooling instead of two), so
    that it trains on a CPU. Accepts any number of points.

    Args:
        num_classes: number of logits.
        k: number of neighbours.
        edge_channels: sizes of the edge convolutions.
        dropout: dropout probability.
        point_channels: channels of the points, or their number.

    Raises:
        UserError: an argument is out of range.
    """

    def __init__(
        self,
        num_classes: int,
        k: int = 16,
        edge_channels: Sequence[int] = (64, 64, 128),
        dropout: float = 0.3,
        point_channels: PointChannels | int = 0,
    ) -> None:
        super().__init__()
        self.point_channels = PointChannels.of(point_channels)
        check_at_least(1, k=k)
        check_channels("edge_channels", edge_channels)
        first = 3 + len(self.point_channels)
        before = [first, *edge_channels[:-1]]
        layers = []
        for channels_in, channels_out in zip(before, edge_channels, strict=True):
            layers.append(EdgeConv(channels_in, channels_out, k))
        self.edges = nn.ModuleList(layers)
        self.pool = PointMaxPool(sum(edge_channels), 1024)
        self.head = classifier_head(num_classes, dropout)

    def forward(self, points: Tensor) -> Tensor:
        """Map ``(B, N, 3 + C)`` points to ``(B, num_classes)`` logits."""
        features = points
        places = coordinates(points)
        outputs = []
        for layer in self.edges:
            features = layer(features, places)
            places = features
            outputs.append(features)
        return self.head(self.pool(torch.cat(outputs, 2)))
