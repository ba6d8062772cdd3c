"""FoldingNet and M-FoldingNet: 2-D grids folded to surfaces.

Yang et al., "FoldingNet: Point Cloud Auto-Encoder via Deep Grid Deformation", CVPR 2018, and the
paper's section "Reconstruction of large-scale point clouds".
"""

import math
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from mops_lightning.errors import UserError
from mops_lightning.nets.autoencoder import PointEncoder
from mops_lightning.nets.folding import Fold
from mops_lightning.nets.pointnet import PointMaxPool, PointMLP, check_channels, linear_norm_relu
from mops_lightning.ops.nearest import k_nearest
from mops_lightning.ops.points import gather_points

REACH = 0.3
"""The grid covers [-0.3, 0.3]², as FoldingNet's."""


def square_grid(n: int) -> Tensor:
    """Return n points ``(n, 2)`` of a regular grid over [-0.3, 0.3]², row by row.

    The sides are the divisors of n that are nearest to each other; where one would be more than
    four times the other, the first n points of the next larger square are taken.
    """
    rows = math.isqrt(n)
    while n % rows:
        rows -= 1
    if rows * rows * 4 < n:
        rows = math.isqrt(n - 1) + 1
    columns = -(-n // rows)
    ticks = [torch.linspace(-REACH, REACH, k) if k > 1 else torch.zeros(1) for k in (rows, columns)]
    return torch.cartesian_prod(*ticks)[:n]


class FoldingDecoder(nn.Module):
    """Cuts the codeword into M pieces and folds a grid with each, all by one folding operator.

    M = 1 is FoldingNet's decoder.

    Args:
        codeword: its size d, a multiple of M.
        pieces: M.
        channels: sizes of the hidden layers of both foldings.

    Raises:
        UserError: the codeword cannot be cut so.
    """

    def __init__(self, codeword: int, pieces: int, channels: Sequence[int]) -> None:
        super().__init__()
        if pieces < 1 or codeword % pieces:
            raise UserError(
                f"task.net.pieces must divide the codeword's {codeword} numbers, got {pieces}."
            )
        check_channels("task.net.fold_channels", channels)
        self.pieces = pieces
        self.first = Fold(codeword // pieces, 2, channels)
        self.second = Fold(codeword // pieces, 3, channels)

    def forward(self, codeword: Tensor, n_points: int) -> Tensor:
        """Map ``(B, d)`` codewords to ``(B, n, 3)``.

        Every piece folds the same grid of n/M points; where that is no whole number, it is rounded
        up and the last pieces do without the last grid point.

        Raises:
            UserError: there are fewer points than pieces.
        """
        if n_points < self.pieces:
            raise UserError(
                f"task.net.n_points must be at least task.net.pieces={self.pieces}, got {n_points}."
            )
        grid = square_grid(-(-n_points // self.pieces)).to(codeword)
        pieces = codeword.reshape(len(codeword) * self.pieces, -1)
        folded = self.second(pieces, self.first(pieces, grid[None]))
        by_grid_point = folded.unflatten(0, (len(codeword), self.pieces)).transpose(1, 2)
        return by_grid_point.flatten(1, 2)[:, :n_points]


class GraphEncoder(nn.Module):
    """FoldingNet's own encoder: local covariances, and two layers that look at the neighbours.

    Args:
        codeword: size of the codeword.
        k: neighbours of a point, itself included.

    Raises:
        UserError: a number is below 1.
    """

    def __init__(self, codeword: int = 512, k: int = 16) -> None:
        super().__init__()
        if min(codeword, k) < 1:
            raise UserError(f"task.net: codeword and k must be at least 1, got {codeword} and {k}.")
        self.codeword = codeword
        self.k = k
        self.features = PointMLP([12, 64, 64, 64])
        self.graph = PointMLP([64, 128])
        self.pool = PointMaxPool(128, 1024)
        self.head = nn.Sequential(
            *linear_norm_relu([1024, codeword]), nn.Linear(codeword, codeword)
        )

    def forward(self, points: Tensor) -> Tensor:
        """Map ``(B, N, 3)`` points to ``(B, d)`` codewords; with fewer points than k, all count."""
        k = min(self.k, points.shape[1])
        with torch.no_grad():
            indices = k_nearest(points, points, k)[1]
        around = gather_points(points, indices.flatten(1)).unflatten(1, indices.shape[1:])
        around = around - around.mean(2, keepdim=True)
        covariance = around.mT @ around / k
        local = self.features(torch.cat([points, covariance.flatten(2)], 2))
        local = self.graph(_largest_around(local, indices))
        return self.head(self.pool(_largest_around(local, indices)))


def _largest_around(features: Tensor, indices: Tensor) -> Tensor:
    """Take, per channel, the maximum of ``(B, N, C)`` over a point's ``(B, N, k)`` neighbours."""
    rows = gather_points(features, indices.flatten(1)).unflatten(1, indices.shape[1:])
    return rows.amax(2)


class MFoldingNet(nn.Module):
    """An encoder, and a decoder that folds one grid per piece of the codeword, all in one way.

    With one piece it is FoldingNet. The hidden layers of a folding are not given by the paper;
    2048 and 144 meet its model sizes best (see the tests): 4.9, 3.3, 3.1, 2.9, 2.9, 2.8, 2.8 MB for
    M = 1, 4, 8, 16, 32, 64, 128 at d = 128, against 4.7, 3.1, 2.9, 2.8, 2.8, 2.8, 2.8.

    Args:
        n_points: how many points are emitted when the call does not say; may change at any time.
        pieces: M.
        codeword: its size d, a multiple of M.
        encoder: ``mlp``, the paper's for all its nets, or ``graph``, FoldingNet's own.
        fold_channels: sizes of the hidden layers of each of the two foldings.

    Raises:
        UserError: a number is out of range.
    """

    def __init__(
        self,
        n_points: int = 1024,
        pieces: int = 4,
        codeword: int = 128,
        encoder: Literal["mlp", "graph"] = "mlp",
        fold_channels: Sequence[int] = (2048, 144),
    ) -> None:
        super().__init__()
        if n_points < pieces:
            raise UserError(
                f"task.net.n_points must be at least task.net.pieces={pieces}, got {n_points}."
            )
        self.n_points = n_points
        make_encoder = GraphEncoder if encoder == "graph" else PointEncoder
        self.encoder = make_encoder(codeword)
        self.decoder = FoldingDecoder(codeword, pieces, fold_channels)

    def forward(self, points: Tensor, n_points: int | None = None) -> Tensor:
        """Map ``(B, N, 3)`` points, any N, to ``(B, n, 3)``; see ``n_points`` above."""
        return self.decoder(self.encoder(points), n_points or self.n_points)
