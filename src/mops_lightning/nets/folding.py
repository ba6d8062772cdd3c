"""The folding operation: a small MLP on [piece of the codeword, coordinates].

Yang et al., "FoldingNet: Point Cloud Auto-Encoder via Deep Grid Deformation", CVPR 2018.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd import Function
from torch.autograd.function import once_differentiable

BLOCK_ROWS = {"cpu": 1024}
"""Grid points per block on a CPU, where the wide hidden layer of a block stays in the cache."""

DEFAULT_BLOCK_ROWS = 2**16
"""Grid points per block on other devices, where a large product is the fastest."""


class Fold(nn.Module):
    """One folding: linear layers on [piece of the codeword, coordinates], with a 3-D output.

    The product with the piece is computed once, not for every grid point. The first hidden layer,
    by far the widest, is computed block by block, and again in the backward pass.

    Args:
        piece: size of a piece of the codeword.
        coordinates: 2 for a grid, 3 for points.
        channels: sizes of the hidden layers, with ReLU.
    """

    def __init__(self, piece: int, coordinates: int, channels: Sequence[int]) -> None:
        super().__init__()
        sizes = [*channels, 3]
        self.from_piece = nn.Linear(piece, sizes[0])
        self.from_coordinates = nn.Linear(coordinates, sizes[0], bias=False)
        self.narrow = nn.Linear(sizes[0], sizes[1])
        rest = [nn.Sequential(nn.ReLU(), nn.Linear(*both)) for both in pairwise(sizes[1:])]
        self.rest = nn.Sequential(*rest)

    def forward(self, pieces: Tensor, coordinates: Tensor) -> Tensor:
        """Map ``(P, piece)`` and ``(P or 1, g, coordinates)`` to ``(P, g, 3)``."""
        narrow, offsets = self.narrow, self.from_piece(pieces)
        others = (coordinates, self.from_coordinates.weight, narrow.weight, narrow.bias)
        # Under autocast, only the offsets would be in half precision.
        return self.rest(_WideLayer.apply(offsets, *(other.to(offsets) for other in others)))


class _WideLayer(Function):
    """relu(o_p + C_pg·Wᵀ)·Vᵀ + b in blocks of P and g, without the full hidden layer in memory.

    o is ``(P, w)``, C ``(P or 1, g, c)``, W ``(w, c)``, V ``(v, w)``, b ``(v,)``; the result is
    ``(P, g, v)``. The backward pass recomputes the hidden layer, at c + 1 products per entry,
    compared with v products for the rest.
    """

    @staticmethod
    def forward(
        ctx: Any, offsets: Tensor, coordinates: Tensor, inner: Tensor, outer: Tensor, bias: Tensor
    ) -> Tensor:
        ctx.save_for_backward(offsets, coordinates, inner, outer)
        result = offsets.new_empty(len(offsets), coordinates.shape[1], len(outer))
        for p, g in _blocks(result):
            hidden = _hidden(offsets[p], _part(coordinates, p, g), inner)
            result[p, g] = torch.addmm(bias, hidden.flatten(0, 1), outer.T).view_as(result[p, g])
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Any) -> Any:
        (grad,) = grads
        offsets, coordinates, inner, outer = ctx.saved_tensors
        d_offsets, d_inner = torch.zeros_like(offsets), torch.zeros_like(inner.T)
        d_outer = torch.zeros_like(outer)
        wanted = ctx.needs_input_grad[1]
        d_coordinates = torch.zeros_like(coordinates) if wanted else None
        for p, g in _blocks(grad):
            places = _part(coordinates, p, g)
            hidden = _hidden(offsets[p], places, inner)
            rows = grad[p, g].flatten(0, 1)
            d_outer.addmm_(rows.T, hidden.flatten(0, 1))
            d_hidden = (rows @ outer).view_as(hidden)
            d_hidden = torch.ops.aten.threshold_backward(d_hidden, hidden, 0)
            # One product gives the sum over the grid and the gradient of W; narrow ones are slow.
            ones = places.new_ones(*places.shape[:2], 1)
            both = torch.cat([places, ones], 2).mT.expand(len(d_hidden), -1, -1) @ d_hidden
            d_inner += both[:, :-1].sum(0)
            d_offsets[p] += both[:, -1]
            if d_coordinates is not None:
                part = (d_hidden.flatten(0, 1) @ inner).view(*d_hidden.shape[:2], -1)
                shared = len(coordinates) == 1
                _part(d_coordinates, p, g).add_(part.sum(0, keepdim=True) if shared else part)
        d_bias = grad.sum((0, 1)) if ctx.needs_input_grad[4] else None
        return d_offsets, d_coordinates, d_inner.T, d_outer, d_bias


def _blocks(result: Tensor) -> Iterator[tuple[slice, slice]]:
    """Yield slices of pieces and of grid points for every block."""
    rows = BLOCK_ROWS.get(result.device.type, DEFAULT_BLOCK_ROWS)
    pieces, grid = result.shape[:2]
    per_grid = min(grid, rows)
    per_piece = max(1, rows // per_grid)
    for first in range(0, pieces, per_piece):
        for begin in range(0, grid, per_grid):
            yield slice(first, first + per_piece), slice(begin, begin + per_grid)


def _part(coordinates: Tensor, pieces: slice, grid: slice) -> Tensor:
    """Return a block of coordinates, which all pieces may share."""
    return coordinates[:, grid] if len(coordinates) == 1 else coordinates[pieces, grid]


def _hidden(offsets: Tensor, coordinates: Tensor, inner: Tensor) -> Tensor:
    """Return the wide hidden layer of a block, ``(p, g, w)``."""
    return (coordinates @ inner.T).add(offsets[:, None]).relu_()
