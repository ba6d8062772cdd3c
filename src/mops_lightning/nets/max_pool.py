"""A linear layer with BatchNorm, ReLU and the maximum over points, without its wide output."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd import Function
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

GROUP = 32
"""Number of consecutive values that ``blocked_argmax`` reduces together."""

PLAIN_MAX_POINTS = 32
"""Up to this number of points, ``PointMaxPool`` computes the plain layers."""


class PointMaxPool(nn.Module):
    """Linear layer, BatchNorm, ReLU and maximum over points, without the (B, N, C) tensor.

    The maximum commutes with the increasing map x ↦ relu(a·x + b), a ≥ 0; for a < 0, the minimum
    takes its place. The wide product is therefore needed only to find the winning point of every
    channel. The mean and variance of the product, for BatchNorm, follow from the mean and
    covariance of the narrower input: mean(Wx) = W·mean(x), var(Wx) = diag(W·cov(x)·Wᵀ). Values and
    gradients equal the plain layers'; gradients flow through the winning points only.

    Args:
        channels_in: channels of the input.
        channels_out: channels of the result.
        norm: whether there is a BatchNorm; without it, the linear layer has a bias.
    """

    def __init__(self, channels_in: int, channels_out: int, norm: bool = True) -> None:
        super().__init__()
        self.linear = nn.Linear(channels_in, channels_out, bias=not norm)
        self.norm: nn.BatchNorm1d | None = None
        if norm:
            self.norm = nn.BatchNorm1d(channels_out)

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(B, N, channels_in)`` to ``(B, channels_out)`` in the dtype of the weights."""
        # The plain layers are faster for few points, and can be exported for any number of clouds.
        few = features.shape[1] <= PLAIN_MAX_POINTS
        # The statistics over all processes of a run are computed by its layer alone.
        across_processes = isinstance(self.norm, nn.SyncBatchNorm)
        if torch.compiler.is_exporting() or few or across_processes:
            return self.values(features).amax(1)
        if self.norm is None:
            increasing = torch.zeros_like(self.linear.bias, dtype=torch.bool)
            extremes = self._extremes(features, increasing)
            return F.relu(extremes + self.linear.bias)
        mean, scale = self._mean_and_scale(self.norm, features)
        is_decreasing = (scale < 0).detach()
        extremes = self._extremes(features, is_decreasing)
        assert self.norm.bias is not None
        normalised = (extremes - mean) * scale
        return F.relu(normalised + self.norm.bias)

    def values(self, features: Tensor) -> Tensor:
        """Return what the maximum is taken of: ``(B, N, channels_out)``, non-negative.

        Args:
            features: as for ``forward``.
        """
        features = features.to(self.linear.weight)
        rows = self.linear(features.flatten(0, 1))
        if self.norm is not None:
            rows = self.norm(rows)
        return rows.relu_().unflatten(0, features.shape[:2])

    def _mean_and_scale(self, norm: nn.BatchNorm1d, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and gamma/std of the wide product, and update the running statistics."""
        weight = self.linear.weight
        assert norm.running_mean is not None
        assert norm.running_var is not None
        if not self.training:
            mean = norm.running_mean
            variance = norm.running_var
        else:
            rows = features.flatten(0, 1).to(weight)
            centre = rows.mean(0)
            centred = rows - centre
            covariance = centred.mT @ centred / rows.shape[0]
            mean = weight @ centre
            variance = ((weight @ covariance) * weight).sum(1)
            with torch.no_grad():
                momentum = 0.1
                if norm.momentum is not None:
                    momentum = norm.momentum
                number = rows.shape[0]
                unbiased = variance * (number / max(number - 1, 1))
                # As BatchNorm's own update, this must not count as an in-place change: a call with
                # few points in the same step has saved these tensors for its backward pass.
                norm.running_mean.data.lerp_(mean.to(norm.running_mean), momentum)
                norm.running_var.data.lerp_(unbiased.to(norm.running_var), momentum)
                if norm.num_batches_tracked is not None:
                    norm.num_batches_tracked += 1
        scale = norm.weight * torch.rsqrt(variance + norm.eps)
        return mean, scale

    def _extremes(self, features: Tensor, decreasing: Tensor) -> Tensor:
        """Return the maximum, or for decreasing channels the minimum, of the product ``(B, C)``."""
        weight = self.linear.weight
        sign = torch.where(decreasing, -1.0, 1.0).to(weight)
        signed = (sign[:, None] * weight).to(features)
        extremes = _MaxOverPoints.apply(features, signed)
        return sign * extremes.to(weight)


class _MaxOverPoints(Function):
    """The maximum over points of a linear map: ``(B, N, D)`` and ``(C, D)`` to ``(B, C)``.

    One point per cloud and channel wins. Both gradients are therefore sums of few weighted rows,
    which ``embedding_bag`` adds without a (B, C, D) tensor: the gradient of the weight sums over
    the winners of a channel, the gradient of the features over the channels that a point wins.
    """

    @staticmethod
    def forward(ctx: Any, features: Tensor, weight: Tensor) -> Tensor:
        clouds, n, _ = features.shape
        if not any(ctx.needs_input_grad):
            maxima = [(weight @ cloud.mT).amax(1) for cloud in features]
            return torch.stack(maxima)
        if features.is_cuda:
            extremes, winners = (weight @ features.mT).max(2)
        else:  # cloud by cloud, the product stays in the cache
            copies = features[:, :1].expand(-1, -n % GROUP, -1)
            padded = torch.cat([features, copies], 1)
            extremes = features.new_empty(clouds, len(weight))
            winners = torch.empty(clouds, len(weight), dtype=torch.int64)
            for cloud, values, rows in zip(padded, extremes, winners, strict=True):
                product = weight @ cloud.mT
                place = blocked_argmax(product)
                largest = product.gather(1, place)
                values.copy_(largest[:, 0])
                rows.copy_(place[:, 0])
            # A padding copy can exceed the first point by a rounding error of the product.
            winners.masked_fill_(winners >= n, 0)
        ctx.save_for_backward(features, weight, winners)
        return extremes

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None]:
        features, weight, winners = ctx.saved_tensors
        (gradient,) = gradients
        dtype = features.dtype
        if dtype.itemsize < 4:  # sums of few rows: float32 costs little here
            features = features.float()
            weight = weight.float()
            gradient = gradient.float()
        clouds, n, _ = features.shape
        channels = len(weight)
        to_features = to_weight = None
        starts_of_clouds = torch.arange(clouds, device=winners.device) * n
        places = winners + starts_of_clouds[:, None]
        if ctx.needs_input_grad[0]:
            places_sorted, order = places.flatten().sort()
            all_places = torch.arange(clouds * n, device=places.device)
            starts = torch.searchsorted(places_sorted, all_places)
            sums = F.embedding_bag(
                order % channels,
                weight,
                starts,
                mode="sum",
                per_sample_weights=gradient.flatten()[order],
            )
            to_features = sums.view_as(features).to(dtype)
        if ctx.needs_input_grad[1]:
            sums = F.embedding_bag(
                places.T.contiguous(),
                features.flatten(0, 1),
                mode="sum",
                per_sample_weights=gradient.T.contiguous(),
            )
            to_weight = sums.to(dtype)
        return to_features, to_weight


def blocked_argmax(values: Tensor) -> Tensor:
    """Return ``values.argmax(1, keepdim=True)``.

    On a CPU, torch vectorises ``amax`` but not ``argmax``. This function therefore reduces groups
    of values first and searches for positions only among the groups and in the winning group.

    Args:
        values: ``(rows, L)``, L a multiple of ``GROUP``.

    Returns:
        ``(rows, 1)`` int64; the lowest position in case of ties.
    """
    groups = values.view(len(values), -1, GROUP)
    group = groups.amax(2).argmax(1, keepdim=True)
    rows = group[..., None].expand(-1, 1, GROUP)
    winners = groups.gather(1, rows)
    return winners.argmax(2).add_(group, alpha=GROUP)
