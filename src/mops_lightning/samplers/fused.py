"""MOPS-Net in evaluation as plain matrix products: BatchNorm fused, points in blocks."""

from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_linear_bn_weights

BLOCK_ROWS = {"cpu": 2048, "cuda": 2**18}
"""Points that pass all layers together: on a CPU their widest layer should stay in the cache."""


class Layer(NamedTuple):
    """A linear layer with ReLU, weights ``(out, in)``."""

    weight: Tensor
    bias: Tensor

    def __call__(self, rows: Tensor) -> Tensor:
        """Map ``(rows, in)`` to ``(rows, out)``."""
        return torch.addmm(self.bias, rows, self.weight.mT).relu_()


class FusedMOPSNet(NamedTuple):
    """What a trained MOPS-Net computes, in three functions of chunks of a cloud.

    Attributes:
        features: the per-point layers.
        local: ρ's first layer, what of it acts on local features.
        global_weight: what of it acts on the global feature, without bias.
        rest: ρ's other hidden layers.
        queries: ``(M, C)``, ρ's last layer over the temperature.
    """

    features: tuple[Layer, ...]
    local: Layer
    global_weight: Tensor
    rest: tuple[Layer, ...]
    queries: Tensor

    @torch.no_grad()
    def local_features(self, points: Tensor) -> Tensor:
        """Map points ``(N, 3)`` to local features ``(N, D)``."""
        result = points.new_empty(len(points), len(self.features[-1].bias))
        size = _block(points)
        for rows, out in zip(points.split(size), result.split(size), strict=True):
            out.copy_(_through(self.features, rows))
        return result

    @torch.no_grad()
    def keys(self, local: Tensor, global_: Tensor, into: Tensor | None = None) -> Tensor:
        """Map local features ``(N, D)`` and a global one ``(D,)`` to the keys ``(N, C)`` of S.

        Args:
            local: of some points of a cloud.
            global_: of the whole cloud.
            into: ``(N, C)``, where to write the keys; None: new memory.
        """
        bias = torch.addmv(self.local.bias, self.global_weight, global_)
        layers = (self.local._replace(bias=bias), *self.rest)
        result = local.new_empty(len(local), self.queries.shape[1]) if into is None else into
        size = _block(local)
        for rows, out in zip(local.split(size), result.split(size), strict=True):
            out.copy_(_through(layers, rows))
        return result


def fuse(
    features: nn.Sequential,
    rho_local: nn.Linear,
    rho_global: nn.Linear,
    rho_norm: nn.BatchNorm1d,
    rho: nn.Sequential,
    queries: Tensor,
) -> FusedMOPSNet:
    """Fuse the running statistics of BatchNorm into the layers before them.

    Args:
        features: the per-point layers.
        rho_local: the part of ρ's first layer that acts on local features.
        rho_global: the part that acts on the global feature.
        rho_norm: the normalisation after the sum of both.
        rho: ρ's other hidden layers.
        queries: ``(M, C)``, ρ's last layer over the temperature.

    Returns:
        The network in evaluation, for chunks of a cloud; weights are copied.
    """
    # The norm's shift belongs to the sum of both parts and is given to one of them.
    local = _fused(rho_local, rho_norm)
    both = _fused(rho_global, rho_norm)
    return FusedMOPSNet(_layers(features), local, both.weight, _layers(rho), queries)


def _layers(stack: nn.Sequential) -> tuple[Layer, ...]:
    modules = list(stack)
    pairs = pairwise(modules)
    return tuple(
        _fused(linear, norm)
        for linear, norm in pairs
        if isinstance(linear, nn.Linear) and isinstance(norm, nn.BatchNorm1d)
    )


def _fused(linear: nn.Linear, norm: nn.BatchNorm1d) -> Layer:
    assert norm.running_mean is not None
    assert norm.running_var is not None
    weight, bias = fuse_linear_bn_weights(
        linear.weight,
        linear.bias,
        norm.running_mean,
        norm.running_var,
        norm.eps,
        norm.weight,
        norm.bias,
    )
    return Layer(weight.detach(), bias.detach())


def _through(layers: tuple[Layer, ...], rows: Tensor) -> Tensor:
    for layer in layers:
        rows = layer(rows)
    return rows


def _block(rows: Tensor) -> int:
    return BLOCK_ROWS.get(rows.device.type, BLOCK_ROWS["cuda"])
