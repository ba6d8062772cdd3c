"""MOPS-Net for inference: BatchNorm fused into linear layers, points processed in blocks."""

from functools import partial, reduce
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_linear_bn_weights

from mops_lightning.ops.attention import Partial, attend

BLOCK_ROWS = {"cpu": 2048, "cuda": 2**18}
"""Points per block: on a CPU, the widest layer of a block stays in the cache."""

PART = 65536
"""Points whose features are in memory at a time."""


class Layer(NamedTuple):
    """A linear layer with ReLU.

    Attributes:
        weight: ``(out, in)``.
        bias: ``(out,)``.
    """

    weight: Tensor
    bias: Tensor

    def __call__(self, rows: Tensor) -> Tensor:
        """Map ``(rows, in)`` to ``(rows, out)``."""
        return torch.addmm(self.bias, rows, self.weight.mT).relu_()


class FusedMOPSNet(NamedTuple):
    """A trained MOPS-Net as functions of chunks of a cloud.

    Attributes:
        features: the pointwise layers of the feature extraction.
        local: the first layer of ρ for local features.
        global_weight: the weights of this layer for the global feature.
        rest: the other hidden layers of ρ.
        queries: ``(M, C)``, the last layer of ρ divided by the temperature.
    """

    features: tuple[Layer, ...]
    local: Layer
    global_weight: Tensor
    rest: tuple[Layer, ...]
    queries: Tensor

    @torch.no_grad()
    def local_features(self, points: Tensor) -> Tensor:
        """Map points ``(N, 3)`` to local features ``(N, D)``."""
        width = len(self.features[-1].bias)
        result = points.new_empty(len(points), width)
        return _in_blocks(self.features, points, result)

    @torch.no_grad()
    def keys(self, local: Tensor, global_: Tensor, into: Tensor | None = None) -> Tensor:
        """Return the keys of the sampling matrix.

        Args:
            local: ``(N, D)``, local features of some points of a cloud.
            global_: ``(D,)``, the global feature of the whole cloud.
            into: ``(N, C)``, a tensor for the result; None allocates one.

        Returns:
            ``(N, C)``.
        """
        bias = torch.addmv(self.local.bias, self.global_weight, global_)
        layers = (self.local._replace(bias=bias), *self.rest)
        if into is None:
            into = local.new_empty(len(local), self.queries.shape[1])
        return _in_blocks(layers, local, into)

    def global_part(self, points: Tensor) -> Tensor:
        """Return the contribution ``(D,)`` of a chunk ``(n, 3)`` to the global feature.

        Contributions merge by maximum.
        """
        parts = points.split(PART)
        peaks = [self.local_features(part).amax(0) for part in parts]
        return torch.stack(peaks).amax(0)

    def sum_part(self, points: Tensor, global_: Tensor, m: int) -> Partial:
        """Return the contribution of a chunk to the generated points; ``Partial.merge`` merges.

        Args:
            points: ``(n, 3)``.
            global_: ``(D,)``, the global feature of the whole cloud.
            m: number of points to generate.

        Returns:
            Sums for m points, with values ``(m, 3)``.
        """
        parts = points.split(PART)
        keys = (self.keys(self.local_features(part), global_) for part in parts)
        sums = map(partial(attend, self.queries[:m]), keys, parts)
        return reduce(Partial.merge, sums)


def fused_layers(stack: nn.Sequential) -> tuple[Layer, ...]:
    """Return the linear layers, with the BatchNorm that follows each."""
    return tuple(
        fused_layer(linear, norm)
        for linear, norm in pairwise(stack)
        if isinstance(linear, nn.Linear) and isinstance(norm, nn.BatchNorm1d)
    )


def fused_layer(linear: nn.Linear, norm: nn.BatchNorm1d) -> Layer:
    """Return a linear layer with BatchNorm's running statistics fused into it, as a copy."""
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


def _in_blocks(layers: tuple[Layer, ...], rows: Tensor, result: Tensor) -> Tensor:
    """Write the output of layers for rows ``(N, in)`` into ``(N, out)``, block by block."""
    size = BLOCK_ROWS.get(rows.device.type, BLOCK_ROWS["cuda"])
    blocks = zip(rows.split(size), result.split(size), strict=True)
    for block, out in blocks:
        for layer in layers:
            block = layer(block)
        out.copy_(block)
    return result
