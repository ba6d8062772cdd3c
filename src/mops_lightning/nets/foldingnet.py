"""FoldingNet and M-FoldingNet: decoders that fold 2-D grids to surfaces.

Yang et al., "FoldingNet: Point Cloud Auto-Encoder via Deep Grid Deformation", CVPR 2018, and the
paper's section "Reconstruction of large-scale point clouds".
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from mops_lightning.errors import UserError
from mops_lightning.nets.autoencoder import PointEncoder
from mops_lightning.nets.folding import Fold
from mops_lightning.nets.layers import check_channels

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
    ticks = [torch.linspace(-REACH, REACH, k) if k > 1 else torch.zeros(1) for k in (rows, columns)]
    return torch.cartesian_prod(*ticks)[:n]


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
        grid = square_grid(-(-n_points // self.pieces)).to(codeword)
        pieces = codeword.reshape(len(codeword) * self.pieces, -1)
        folded = self.second(pieces, self.first(pieces, grid[None]))
        by_grid_point = folded.unflatten(0, (len(codeword), self.pieces)).transpose(1, 2)
        return by_grid_point.flatten(1, 2)[:, :n_points]


class MFoldingNet(nn.Module):
    """M-FoldingNet: an encoder, and a decoder that folds one grid per piece of the codeword.

    With one piece it is FoldingNet. The paper does not give the hidden layers of a folding; 2048
    and 144 match its model sizes best: 4.9, 3.3, 3.1, 2.9, 2.9, 2.8, 2.8 MB for M = 1, 4, 8, 16,
    32, 64, 128 at d = 128, compared with 4.7, 3.1, 2.9, 2.8, 2.8, 2.8, 2.8 MB in the paper.

    Args:
        n_points: default number of output points; the attribute may be changed at any time.
        pieces: M.
        codeword: size d of the codeword, a multiple of M.
        fold_channels: sizes of the hidden layers of each of the two foldings.

    Raises:
        UserError: an argument is out of range.
    """

    def __init__(
        self,
        n_points: int = 1024,
        pieces: int = 4,
        codeword: int = 128,
        fold_channels: Sequence[int] = (2048, 144),
    ) -> None:
        super().__init__()
        if n_points < pieces:
            raise UserError(f"n_points must be at least pieces={pieces}, got {n_points}.")
        self.n_points = n_points
        self.encoder = PointEncoder(codeword)
        self.decoder = FoldingDecoder(codeword, pieces, fold_channels)

    def forward(self, points: Tensor, n_points: int | None = None) -> Tensor:
        """Map ``(B, N, 3)`` points, any N, to ``(B, n, 3)``.

        Args:
            points: the sampled or the full cloud.
            n_points: n; None means the attribute ``n_points``.
        """
        return self.from_pooled(self.encoder(points), n_points)

    def point_features(self, points: Tensor) -> Tensor:
        """Return the features ``(B, N, d)`` whose maxima over points are the codeword."""
        return self.encoder.point_features(points)

    def from_pooled(self, pooled: Tensor, n_points: int | None = None) -> Tensor:
        """Map codewords ``(B, d)`` to ``(B, n, 3)``; ``n_points`` as for ``forward``."""
        return self.decoder(pooled, n_points or self.n_points)
