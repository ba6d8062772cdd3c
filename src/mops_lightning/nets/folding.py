"""The folding operator: a small MLP on [codeword piece, coordinates], block by block.

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
"""Grid points whose wide hidden layer is held at a time; on a CPU it then stays in the cache."""
MANY_ROWS = 2**16
"""The same for all other devices, where one large product is the fastest."""


class Fold(nn.Module):
    """One folding: linear layers on [codeword piece, coordinates], the last one to 3-D.

    The piece is multiplied once, not once per grid point, and the first hidden layer, by far the
    widest, is never held for all grid points: the way back computes it anew.

    Args:
        piece: size of the codeword piece.
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
        """Fold ``(P, piece)`` and ``(P or 1, g, coordinates)`` to ``(P, g, 3)``."""
        narrow, offsets = self.narrow, self.from_piece(pieces)
        others = (coordinates, self.from_coordinates.weight, narrow.weight, narrow.bias)
        # Under autocast the offsets alone would be of half precision.
        return self.rest(_WideLayer.apply(offsets, *(other.to(offsets) for other in others)))


class _WideLayer(Function):
    """relu(o_p + C_pg·Wᵀ)·Vᵀ + b by blocks of P and g, without the wide hidden layer in memory.

    o is ``(P, w)``, C ``(P or 1, g, c)``, W ``(w, c)``, V ``(v, w)``, b ``(v,)``; the result is
    ``(P, g, v)``. The backward pass makes the hidden layer anew, which costs c + 1 products per
    number against the v of the rest.
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
            # One product for the sum over the grid and the gradient of W: skinny ones are slow.
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
    """Yield slices of pieces and of grid points, whose product is a block."""
    rows = BLOCK_ROWS.get(result.device.type, MANY_ROWS)
    pieces, grid = result.shape[:2]
    per_grid = min(grid, rows)
    per_piece = max(1, rows // per_grid)
    for first in range(0, pieces, per_piece):
        for begin in range(0, grid, per_grid):
            yield slice(first, first + per_piece), slice(begin, begin + per_grid)


def _part(coordinates: Tensor, pieces: slice, grid: slice) -> Tensor:
    """Cut a block out of coordinates that may be shared by all pieces."""
    return coordinates[:, grid] if len(coordinates) == 1 else coordinates[pieces, grid]


def _hidden(offsets: Tensor, coordinates: Tensor, inner: Tensor) -> Tensor:
    """Return the wide layer of one block, ``(p, g, w)``."""
    return (coordinates @ inner.T).add(offsets[:, None]).relu_()
