"""PointNet vanilla and the shared per-point layers that samplers and task nets are made of.

Layers work on ``(B·N, C)`` rows: BatchNorm over rows is 1.6 times faster on a CPU than over
``(B, C, N)``, and a linear layer is one matrix product.
"""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mops_lightning.geometry import GROUP, first_extreme


def linear_norm_relu(channels: Sequence[int]) -> nn.Sequential:
    """Stack linear layers, each followed by BatchNorm and ReLU.

    Args:
        channels: input size, then the output size of every layer.

    Returns:
        A module from ``(rows, channels[0])`` to ``(rows, channels[-1])``. The linear layers have
        no bias: BatchNorm would cancel it.
    """
    layers: list[nn.Module] = []
    for before, after in pairwise(channels):
        layers += [
            nn.Linear(before, after, bias=False),
            nn.BatchNorm1d(after),
            nn.ReLU(inplace=True),
        ]
    return nn.Sequential(*layers)


class PointMLP(nn.Module):
    """One MLP shared by all points.

    Args:
        channels: input size, then the output size of every layer.
    """

    def __init__(self, channels: Sequence[int]) -> None:
        super().__init__()
        self.layers = linear_norm_relu(channels)

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(B, N, channels[0])`` to ``(B, N, channels[-1])``."""
        return self.layers(features.flatten(0, 1)).unflatten(0, features.shape[:2])


class PointMaxPool(nn.Module):
    """Linear layer, BatchNorm, ReLU and the maximum over points, without the (B, N, C) tensor.

    The maximum commutes with the increasing map x ↦ relu(a·x + b), a ≥ 0 (for a < 0 the minimum
    takes its place), so the wide product is needed only to find which point wins a channel. What
    BatchNorm needs beyond that, mean and variance of the product, follows from the mean and the
    covariance of the narrower input: mean(Wx) = W·mean(x), var(Wx) = diag(W·cov(x)·Wᵀ). Values and
    gradients are those of the plain layers; gradients flow through the winning points only.

    Args:
        channels_in: C of the input.
        channels_out: C of the result.
    """

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.linear = nn.Linear(channels_in, channels_out, bias=False)
        self.norm = nn.BatchNorm1d(channels_out)

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(B, N, channels_in)`` to ``(B, channels_out)``."""
        if features.shape[1] <= features.shape[2]:
            # Fewer points than channels: the plain product is smaller than the gathered winners.
            rows = F.linear(features.flatten(0, 1), self.linear.weight)
            return F.relu(self.norm(rows).unflatten(0, features.shape[:2]).amax(1))
        mean, scale = self._normalisation(features)
        peaks = self._peaks(features, (scale < 0).detach())
        assert self.norm.bias is not None
        return F.relu((peaks - mean) * scale + self.norm.bias)

    def _normalisation(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and gamma/std of the wide product, and update the running statistics."""
        norm, weight = self.norm, self.linear.weight
        assert norm.running_mean is not None
        assert norm.running_var is not None
        if not self.training:
            mean, variance = norm.running_mean, norm.running_var
        else:
            rows = features.flatten(0, 1)
            centre = rows.mean(0)
            centred = rows - centre
            covariance = centred.mT @ centred / rows.shape[0]
            mean = weight @ centre
            variance = ((weight @ covariance) * weight).sum(1)
            with torch.no_grad():
                momentum = 0.1 if norm.momentum is None else norm.momentum
                unbiased = variance * (rows.shape[0] / max(rows.shape[0] - 1, 1))
                norm.running_mean.lerp_(mean.to(norm.running_mean.dtype), momentum)
                norm.running_var.lerp_(unbiased.to(norm.running_var.dtype), momentum)
                if norm.num_batches_tracked is not None:
                    norm.num_batches_tracked += 1
        return mean, norm.weight * torch.rsqrt(variance + norm.eps)

    def _peaks(self, features: Tensor, falling: Tensor) -> Tensor:
        """Return, per cloud and channel, the extreme value of the product: ``(B, C)``."""
        weight = self.linear.weight
        with torch.no_grad():
            search = torch.where(falling[:, None], -weight, weight)
            if features.is_cuda:
                winners = (search @ features.mT).argmax(2)
            else:  # cloud by cloud the product stays in the cache
                surplus = -features.shape[1] % GROUP
                filled = torch.cat([features, features[:, :1].expand(-1, surplus, -1)], 1)
                rows = [first_extreme(search @ cloud.mT, largest=True) for cloud in filled]
                winners = torch.stack(rows).squeeze(2)
                # A copy may beat the first point itself by a rounding error of the product.
                winners.masked_fill_(winners >= features.shape[1], 0)
        # Whole rows of the flat tensor: an index for every number takes three times as long.
        clouds = torch.arange(len(features), device=features.device)
        places = (winners + clouds[:, None] * features.shape[1]).flatten()
        winning = features.flatten(0, 1).index_select(0, places).unflatten(0, winners.shape)
        return (winning * weight).sum(-1)


class PointNetVanilla(nn.Module):
    """PointNet without transform nets, the classifier of the paper's section "Classification".

    Layers 64, 64, 64, 128, 1024 per point, maximum over points, 512, 256, ``num_classes``; dropout
    after the 256. Takes any number of points.

    Args:
        num_classes: number of logits.
        dropout: share of the 256 features that is dropped in training.
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


class PointFeatures(nn.Module):
    """Local and global features of a cloud, paper section "Feature Extraction".

    Args:
        channels: sizes of the per-point layers after the coordinates.
    """

    def __init__(self, channels: Sequence[int] = (64, 64, 64, 128, 128)) -> None:
        super().__init__()
        self.mlp = PointMLP([3, *channels])

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return local features ``(B, N, C)`` and their maximum over points ``(B, C)``."""
        local = self.mlp(points)
        return local, local.amax(1)
