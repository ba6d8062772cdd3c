"""PointNet vanilla and the shared per-point layers that samplers and task nets are made of.

Layers work on ``(B·N, C)`` rows: BatchNorm over rows is 1.6 times faster on a CPU than over
``(B, C, N)``, and a linear layer is one matrix product.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd import Function
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from mops_lightning.errors import UserError
from mops_lightning.ops.extreme import GROUP, blocked_argextreme
from mops_lightning.ops.precision import pointwise_autocast, pointwise_autocast_dtype

FEW_POINTS = 32
"""Up to here ``PointMaxPool`` computes the plain layers; on a CPU both ways are equal around it."""


def check_channels(setting: str, channels: Sequence[int], min_layers: int = 1) -> None:
    """Refuse layers that cannot be built.

    Args:
        setting: its name, for the error.
        channels: sizes of layers.
        min_layers: how many there must be.

    Raises:
        UserError: there are fewer, or one has no channels.
    """
    if len(channels) < min_layers or min(channels) < 1:
        layers = "layer" if min_layers == 1 else "layers"
        raise UserError(
            f"{setting} must be sizes of at least {min_layers} {layers}, each at least 1, "
            f"got {list(channels)}."
        )


def linear_norm_relu(channels: Sequence[int], norm: bool = True) -> nn.Sequential:
    """Stack linear layers, each followed by BatchNorm and ReLU.

    Args:
        channels: input size, then the output size of every layer.
        norm: False leaves BatchNorm out.

    Returns:
        A module from ``(rows, channels[0])`` to ``(rows, channels[-1])``. Before BatchNorm the
        linear layers have no bias: it would be cancelled.
    """
    layers: list[nn.Module] = []
    for before, after in pairwise(channels):
        layers += [nn.Linear(before, after, bias=not norm)]
        layers += [nn.BatchNorm1d(after)] if norm else []
        layers += [nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)


class PointMLP(nn.Module):
    """One MLP shared by all points.

    In mixed precision all but its first layer, which sees coordinates, is of half precision, and so
    is the result.

    Args:
        channels: input size, then the output size of every layer.
        norm: False leaves BatchNorm out.
    """

    def __init__(self, channels: Sequence[int], norm: bool = True) -> None:
        super().__init__()
        self.layers = linear_norm_relu(channels, norm)

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(B, N, channels[0])`` to ``(B, N, channels[-1])``."""
        rows = features.flatten(0, 1)
        if pointwise_autocast_dtype() is None:
            return self.layers(rows).unflatten(0, features.shape[:2])
        first, *others = self.layers.children()
        rows = first(rows.to(next(first.parameters())))
        with pointwise_autocast(rows.device.type):
            for layer in others:
                rows = layer(rows)
        return rows.unflatten(0, features.shape[:2])


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
        norm: False leaves BatchNorm out; the linear layer then has a bias.
    """

    def __init__(self, channels_in: int, channels_out: int, norm: bool = True) -> None:
        super().__init__()
        self.linear = nn.Linear(channels_in, channels_out, bias=not norm)
        self.norm = nn.BatchNorm1d(channels_out) if norm else None

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(B, N, channels_in)`` to ``(B, channels_out)`` in the precision of the weights."""
        if features.shape[1] <= FEW_POINTS:
            features = features.to(self.linear.weight)
            # For few points the plain product costs less than what finding winners adds to it.
            rows = self.linear(features.flatten(0, 1))
            rows = rows if self.norm is None else self.norm(rows)
            return F.relu(rows.unflatten(0, features.shape[:2]).amax(1))
        if self.norm is None:
            rising = torch.zeros_like(self.linear.bias, dtype=torch.bool)
            return F.relu(self._peaks(features, rising) + self.linear.bias)
        mean, scale = self._normalisation(self.norm, features)
        peaks = self._peaks(features, (scale < 0).detach())
        assert self.norm.bias is not None
        return F.relu((peaks - mean) * scale + self.norm.bias)

    def _normalisation(self, norm: nn.BatchNorm1d, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and gamma/std of the wide product, and update the running statistics."""
        weight = self.linear.weight
        assert norm.running_mean is not None
        assert norm.running_var is not None
        if not self.training:
            mean, variance = norm.running_mean, norm.running_var
        else:
            rows = features.flatten(0, 1).to(weight)
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
        sign = torch.where(falling, -1.0, 1.0).to(weight)
        turned = (sign[:, None] * weight).to(features)
        return sign * _MaxOverPoints.apply(features, turned).to(weight)


class _MaxOverPoints(Function):
    """The maximum over points of a linear map: ``(B, N, D)`` and ``(C, D)`` to ``(B, C)``.

    One point per cloud and channel wins, so both gradients are sums of few weighted rows: those of
    the weight over the winners of a channel, those of the features over the channels that a point
    has won. ``embedding_bag`` adds them up without the (B, C, D) tensor between.
    """

    @staticmethod
    def forward(ctx: Any, features: Tensor, weight: Tensor) -> Tensor:
        clouds, n, _ = features.shape
        if not any(ctx.needs_input_grad):
            return torch.stack([(weight @ cloud.mT).amax(1) for cloud in features])
        if features.is_cuda:
            peaks, winners = (weight @ features.mT).max(2)
        else:  # cloud by cloud the product stays in the cache
            filled = torch.cat([features, features[:, :1].expand(-1, -n % GROUP, -1)], 1)
            peaks = features.new_empty(clouds, len(weight))
            winners = torch.empty(clouds, len(weight), dtype=torch.int64)
            for cloud, values, rows in zip(filled, peaks, winners, strict=True):
                product = weight @ cloud.mT
                place = blocked_argextreme(product, largest=True)
                values.copy_(product.gather(1, place)[:, 0])
                rows.copy_(place[:, 0])
            # A copy may beat the first point itself by a rounding error of the product.
            winners.masked_fill_(winners >= n, 0)
        ctx.save_for_backward(features, weight, winners)
        return peaks

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None]:
        features, weight, winners = ctx.saved_tensors
        (gradient,) = gradients
        kind = features.dtype
        if kind.itemsize < 4:  # few rows are summed here: no need to do so coarsely
            features, weight, gradient = features.float(), weight.float(), gradient.float()
        clouds, n, _ = features.shape
        channels = len(weight)
        to_features = to_weight = None
        places = winners + torch.arange(clouds, device=winners.device)[:, None] * n
        if ctx.needs_input_grad[0]:
            places_sorted, order = places.flatten().sort()
            starts = torch.searchsorted(
                places_sorted, torch.arange(clouds * n, device=places.device)
            )
            to_features = F.embedding_bag(
                order % channels,
                weight,
                starts,
                mode="sum",
                per_sample_weights=gradient.flatten()[order],
            ).view_as(features)
        if ctx.needs_input_grad[1]:
            to_weight = F.embedding_bag(
                places.T.contiguous(),
                features.flatten(0, 1),
                mode="sum",
                per_sample_weights=gradient.T.contiguous(),
            )
        return (
            None if to_features is None else to_features.to(kind),
            None if to_weight is None else to_weight.to(kind),
        )


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
