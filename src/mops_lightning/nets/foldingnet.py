"""FoldingNet and M-FoldingNet: decoders that fold 2-D grids to surfaces.

Yang et al., "FoldingNet: Point Cloud Auto-Encoder via Deep Grid Deformation", CVPR 2018, and the
paper's section "Reconstruction of large-scale point clouds".
"""

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from mops_lightning.channels import PointChannels
from mops_lightning.errors import UserError
from mops_lightning.nets.autoencoder import PointEncoder, Reconstructor
from mops_lightning.nets.layers import check_channels

BLOCK_ROWS = {"cpu": 1024}
"""Grid points per block on a CPU, where the wide hidden layer of a block stays in the cache."""

DEFAULT_BLOCK_ROWS = 2**16
"""Grid points per block on other devices, where a large product is the fastest."""

REACH = 0.3
"""The grid covers [-0.3, 0.3]², as in FoldingNet."""


def square_grid(n: int) -> Tensor:
    """Return n points of a regular grid over [-0.3, 0.3]², row by row.

    The grid has the most nearly square shape with n points. If its sides differ by more than a
    factor of four, as for a prime number, the first n points of a nearly square grid are returned.

    Args:
        n: number of points.

    Returns:
        ``(n, 2)`` float32.
    """
    rows = math.isqrt(n)
    while n % rows:
        rows -= 1
    if rows * rows * 4 < n:
        rows = math.isqrt(n - 1) + 1
    columns = -(-n // rows)
    grid = torch.cartesian_prod(_ticks(rows), _ticks(columns))
    return grid[:n]


def _ticks(number: int) -> Tensor:
    if number == 1:
        return torch.zeros(1)
    return torch.linspace(-REACH, REACH, number)


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
        first, second, *others = (*channels, 3)
        self.from_piece = nn.Linear(piece, first)
        self.from_coordinates = nn.Linear(coordinates, first, bias=False)
        self.narrow = nn.Linear(first, second)
        rest = []
        for before, after in pairwise([second, *others]):
            rest.append(nn.Sequential(nn.ReLU(), nn.Linear(before, after)))
        self.rest = nn.Sequential(*rest)

    def forward(self, pieces: Tensor, coordinates: Tensor) -> Tensor:
        """Map ``(P, piece)`` and ``(P or 1, g, coordinates)`` to ``(P, g, 3)``."""
        narrow = self.narrow
        offsets = self.from_piece(pieces)
        others = (coordinates, self.from_coordinates.weight, narrow.weight, narrow.bias)
        # Under autocast, only the offsets would be in half precision.
        like_offsets = [other.to(offsets) for other in others]
        return self.rest(_WideLayer.apply(offsets, *like_offsets))


class _WideLayer(Function):
    """relu(o_p + C_pg·Wᵀ)·Vᵀ + b in blocks of P and g, without the full hidden layer in memory.

    o is ``(P, w)``, C ``(P or 1, g, c)``, W ``(w, c)``, V ``(v, w)``, b ``(v,)``; the result is
    ``(P, g, v)``. The backward pass recomputes the hidden layer, at c + 1 products per entry,
    compared with v products for the rest.
    """

    @staticmethod
    def forward(
        ctx: Any,
        offsets: Tensor,
        coordinates: Tensor,
        inner: Tensor,
        outer: Tensor,
        bias: Tensor,
    ) -> Tensor:
        ctx.save_for_backward(offsets, coordinates, inner, outer)
        grid = coordinates.shape[1]
        result = offsets.new_empty(len(offsets), grid, len(outer))
        for p, g in _blocks(result):
            places = _part(coordinates, p, g)
            hidden = _hidden(offsets[p], places, inner)
            rows = torch.addmm(bias, hidden.flatten(0, 1), outer.T)
            result[p, g] = rows.view_as(result[p, g])
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Any) -> Any:
        (grad,) = grads
        offsets, coordinates, inner, outer = ctx.saved_tensors
        d_offsets = torch.zeros_like(offsets)
        d_inner = torch.zeros_like(inner.T)
        d_outer = torch.zeros_like(outer)
        d_coordinates = None
        if ctx.needs_input_grad[1]:
            d_coordinates = torch.zeros_like(coordinates)
        for p, g in _blocks(grad):
            places = _part(coordinates, p, g)
            hidden = _hidden(offsets[p], places, inner)
            rows = grad[p, g].flatten(0, 1)
            d_outer.addmm_(rows.T, hidden.flatten(0, 1))
            d_hidden = (rows @ outer).view_as(hidden)
            d_hidden = torch.ops.aten.threshold_backward(d_hidden, hidden, 0)
            # One product gives the sum over the grid and the gradient of W; narrow ones are slow.
            ones = places.new_ones(*places.shape[:2], 1)
            extended = torch.cat([places, ones], 2).mT
            both = extended.expand(len(d_hidden), -1, -1) @ d_hidden
            d_inner += both[:, :-1].sum(0)
            d_offsets[p] += both[:, -1]
            if d_coordinates is not None:
                part = (d_hidden.flatten(0, 1) @ inner).view(*d_hidden.shape[:2], -1)
                if len(coordinates) == 1:  # all pieces share it
                    part = part.sum(0, keepdim=True)
                _part(d_coordinates, p, g).add_(part)
        d_bias = None
        if ctx.needs_input_grad[4]:
            d_bias = grad.sum((0, 1))
        return d_offsets, d_coordinates, d_inner.T, d_outer, d_bias


def _blocks(result: Tensor) -> Iterator[tuple[slice, slice]]:
    """Yield slices of pieces and of grid points for every block."""
    rows = BLOCK_ROWS.get(result.device.type, DEFAULT_BLOCK_ROWS)
    pieces, grid = result.shape[:2]
    per_grid = min(grid, rows)
    per_piece = max(1, rows // per_grid)
    for first in range(0, pieces, per_piece):
        for begin in range(0, grid, per_grid):
            some_pieces = slice(first, first + per_piece)
            yield some_pieces, slice(begin, begin + per_grid)


def _part(coordinates: Tensor, pieces: slice, grid: slice) -> Tensor:
    """Return a block of coordinates, which all pieces may share."""
    if len(coordinates) == 1:
        return coordinates[:, grid]
    return coordinates[pieces, grid]


def _hidden(offsets: Tensor, coordinates: Tensor, inner: Tensor) -> Tensor:
    """Return the wide hidden layer of a block, ``(p, g, w)``."""
    hidden = (coordinates @ inner.T).add(offsets[:, None])
    return hidden.relu_()


class FoldingDecoder(nn.Module):
    """Splits the codeword into M pieces and folds a grid with each, with shared weights.

    With M = 1 it is FoldingNet's decoder.

    Args:
        codeword: size d of the codeword, a multiple of M.
        pieces: M.
        fold_channels: sizes of the hidden layers of both foldings.

    Raises:
        UserError: an argument is out of range.
    """

    def __init__(self, codeword: int, pieces: int, fold_channels: Sequence[int]) -> None:
        super().__init__()
        if pieces < 1 or codeword % pieces:
            raise UserError(f"pieces must be a divisor of codeword={codeword}, got {pieces}.")
        check_channels("fold_channels", fold_channels)
        self.pieces = pieces
        self.first = Fold(codeword // pieces, 2, fold_channels)
        self.second = Fold(codeword // pieces, 3, fold_channels)

    def forward(self, codeword: Tensor, n_points: int) -> Tensor:
        """Map ``(B, d)`` codewords to ``(B, n, 3)``.

        Every piece folds the same grid of ⌈n/M⌉ points; surplus points are dropped from the last
        pieces.

        Raises:
            UserError: n is smaller than M.
        """
        if n_points < self.pieces:
            raise UserError(f"n_points must be at least pieces={self.pieces}, got {n_points}.")
        points_of_piece = -(-n_points // self.pieces)
        grid = square_grid(points_of_piece).to(codeword)
        clouds = len(codeword)
        pieces = codeword.reshape(clouds * self.pieces, -1)
        folded = self.second(pieces, self.first(pieces, grid[None]))
        by_piece = folded.unflatten(0, (clouds, self.pieces))
        by_grid_point = by_piece.transpose(1, 2)
        return by_grid_point.flatten(1, 2)[:, :n_points]


class MFoldingNet(Reconstructor):
    """M-FoldingNet: an encoder, and a decoder that folds one grid per piece of the codeword.

    With one piece it is FoldingNet. The paper does not give the hidden layers of a folding; 2048
    and 144 match its model sizes best: 4.9, 3.3, 3.1, 2.9, 2.9, 2.8, 2.8 MB for M = 1, 4, 8, 16,
    32, 64, 128 at d = 128, compared with 4.7, 3.1, 2.9, 2.8, 2.8, 2.8, 2.8 MB in the paper.

    Args:
        n_points: default number of output points; the attribute may be changed at any time.
        pieces: M.
        codeword: size d of the codeword, a multiple of M.
        fold_channels: sizes of the hidden layers of each of the two foldings.
        point_channels: channels of the points that the encoder sees, or their number.

    Raises:
        UserError: an argument is out of range.
    """

    def __init__(
        self,
        n_points: int = 1024,
        pieces: int = 4,
        codeword: int = 128,
        fold_channels: Sequence[int] = (2048, 144),
        point_channels: PointChannels | int = 0,
    ) -> None:
        super().__init__()
        if n_points < pieces:
            raise UserError(f"n_points must be at least pieces={pieces}, got {n_points}.")
        self.n_points = n_points
        self.encoder = PointEncoder(codeword, point_channels=point_channels)
        self.decoder = FoldingDecoder(codeword, pieces, fold_channels)

    def from_pooled(self, pooled: Tensor, n_points: int | None = None) -> Tensor:
        """Map codewords ``(B, d)`` to ``(B, n, 3)``; ``n_points`` as for ``forward``."""
        return self.decoder(pooled, n_points or self.n_points)
