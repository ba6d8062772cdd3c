"""The feature net of APES and SAMBLE: edge convolutions, then attention to neighbours.

Neighbours are the k nearest points in the space of the current features, as published. In mixed
precision, the layers of edges and the feed-forward nets are in half precision, as wide layers of
MOPS-Net are; differences from a point and attention are in full precision.
"""

import torch
from torch import Tensor, nn

from mops_lightning.errors import UserError, check_at_least
from mops_lightning.ops.nearest import nearest_features
from mops_lightning.ops.precision import pointwise_autocast

SLOPE = 0.2
"""Of the leaky ReLU."""


def neighbour_mask(rows: Tensor) -> Tensor:
    """Return which points ``(B, N, N)`` are neighbours of each, from their rows ``(B, N, k)``."""
    clouds, n, _ = rows.shape
    mask = torch.zeros(clouds, n, n, dtype=torch.bool, device=rows.device)
    return mask.scatter_(2, rows, True)


def gather_features(features: Tensor, rows: Tensor) -> Tensor:
    """Return the features ``(B, N, k, C)`` of the neighbours ``(B, N, k)`` of every point.

    It copies whole rows, which takes a fifth of the time of ``gather_points``.
    """
    clouds, n, channels = features.shape
    first = torch.arange(clouds, device=features.device)[:, None, None] * n
    near = features.flatten(0, 1).index_select(0, (first + rows).flatten())
    return near.view(*rows.shape, channels)


class EdgeConvolution(nn.Module):
    """Two layers on [f_i, f_j − f_i] of every neighbour j, then the maximum over the neighbours.

    Args:
        channels_in: channels of f.
        hidden: channels of the first layer.
        channels_out: channels of the result.
        k: number of neighbours.
    """

    def __init__(self, channels_in: int, hidden: int, channels_out: int, k: int) -> None:
        super().__init__()
        self.k = k
        self.first = nn.Linear(2 * channels_in, hidden, bias=False)
        self.rest = nn.Sequential(
            nn.BatchNorm1d(hidden),
            nn.LeakyReLU(SLOPE),
            nn.Linear(hidden, channels_out, bias=False),
            nn.BatchNorm1d(channels_out),
            nn.LeakyReLU(SLOPE),
        )

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(B, N, channels_in)`` to ``(B, N, channels_out)``."""
        of_own, of_difference = self.first.weight.split(features.shape[2], 1)
        # The first layer is linear: it is applied to every point once, not to every edge.
        own = nn.functional.linear(features, of_own - of_difference)
        neighbour = nn.functional.linear(features, of_difference)
        near = gather_features(neighbour, nearest_features(features, self.k))
        edges = own[:, :, None] + near
        with pointwise_autocast(features.device.type):
            mapped = self.rest(edges.flatten(0, 2)).unflatten(0, edges.shape[:3])
        return mapped.max(2).values.to(features)


def check_channels(channels: int, heads: int) -> None:
    """Reject channels that two convolutions or all heads cannot share equally.

    Raises:
        UserError: it says which channels are allowed.
    """
    check_at_least(2, channels=channels)
    check_at_least(1, heads=heads)
    if channels % 2 or channels % heads:
        raise UserError(f"channels must be even and a multiple of heads={heads}, got {channels}.")


class EdgeEmbedding(nn.Module):
    """Two edge convolutions, whose outputs are joined.

    Args:
        hidden: channels of the hidden layer of the first and of the second convolution.
        channels: channels of the result, half of them from each convolution.
        k: number of neighbours.
    """

    def __init__(self, hidden: tuple[int, int], channels: int, k: int) -> None:
        super().__init__()
        half = channels // 2
        self.first = EdgeConvolution(3, hidden[0], half, k)
        self.second = EdgeConvolution(half, hidden[1], half, k)

    def forward(self, points: Tensor) -> Tensor:
        """Map ``(B, N, 3)`` points to features ``(B, N, channels)``."""
        first = self.first(points)
        return torch.cat([first, self.second(first)], 2)


class NeighbourAttention(nn.Module):
    """Attention of every point to its neighbours, then a feed-forward net, each added to its input.

    Keys and values are those of f_j − f_i. BatchNorm follows each sum.

    Args:
        channels: channels of input and output.
        heads: number of heads.
        expansion: width of the feed-forward net's hidden layer over that of its input.
        k: number of neighbours.
    """

    def __init__(self, channels: int, heads: int, expansion: int, k: int) -> None:
        super().__init__()
        self.heads = heads
        self.k = k
        self.queries = nn.Linear(channels, channels, bias=False)
        self.keys = nn.Linear(channels, channels, bias=False)
        self.values = nn.Linear(channels, channels, bias=False)
        self.attention_norm = nn.BatchNorm1d(channels)
        self.feed_forward = nn.Sequential(
            nn.Linear(channels, expansion * channels, bias=False),
            nn.LeakyReLU(SLOPE),
            nn.Linear(expansion * channels, channels, bias=False),
        )
        self.feed_forward_norm = nn.BatchNorm1d(channels)

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(B, N, channels)`` to ``(B, N, channels)``."""
        mixed = (features + self.attend(features)).flatten(0, 1)
        mixed = self.attention_norm(mixed)
        with pointwise_autocast(features.device.type):
            correction = self.feed_forward(mixed)
        result = self.feed_forward_norm(mixed + correction)
        return result.view_as(features)

    def attend(self, features: Tensor) -> Tensor:
        """Return the attention ``(B, N, channels)`` of every point to its neighbours."""
        near = neighbour_mask(nearest_features(features, self.k))
        queries = self._by_head(self.queries(features))
        # The key of f_j − f_i differs from that of f_j by the same for all j: softmax cancels it.
        keys = self._by_head(self.keys(features))
        values = self.values(features)
        # All pairs with a mask take less time and memory than the gathered keys and values.
        means = nn.functional.scaled_dot_product_attention(
            queries, keys, self._by_head(values), attn_mask=near[:, None]
        )
        return means.transpose(1, 2).flatten(2) - values

    def _by_head(self, features: Tensor) -> Tensor:
        """Return ``(B, heads, N, C / heads)`` of ``(B, N, C)``."""
        return features.unflatten(2, (self.heads, -1)).transpose(1, 2)
