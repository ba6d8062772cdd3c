"""FoldingNet and M-FoldingNet: decoders that fold 2-D grids to surfaces.

Yang et al., "FoldingNet: Point Cloud Auto-Encoder via Deep Grid Deformation", CVPR 2018, and the
paper's section "Reconstruction of large-scale point clouds".
"""

import math
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.nets.autoencoder import PointEncoder
from mops_lightning.nets.folding import Fold
from mops_lightning.nets.layers import PointMLP, check_channels, linear_norm_relu
from mops_lightning.nets.max_pool import PointMaxPool
from mops_lightning.ops.nearest import k_nearest
from mops_lightning.ops.points import gather_points

REACH = 0.3
"""The grid covers [-0.3, 0.3]², as in FoldingNet."""

ENCODERS = ("mlp", "graph")


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


class GraphEncoder(nn.Module):
    """FoldingNet's graph-based encoder: local covariances, and two graph layers.

    Args:
        codeword: size d of the codeword.
        k: neighbours of a point, including itself.

    Raises:
        UserError: an argument is below 1.
    """

    def __init__(self, codeword: int = 512, k: int = 16) -> None:
        super().__init__()
        if codeword < 1:
            raise UserError(f"codeword must be at least 1, got {codeword}.")
        if k < 1:
            raise UserError(f"k must be at least 1, got {k}.")
        self.codeword = codeword
        self.k = k
        self.features = PointMLP([12, 64, 64, 64])
        self.graph = PointMLP([64, 128])
        self.pool = PointMaxPool(128, 1024)
        self.head = nn.Sequential(
            *linear_norm_relu([1024, codeword]), nn.Linear(codeword, codeword)
        )

    def forward(self, points: Tensor) -> Tensor:
        """Map ``(B, N, 3)`` points, any N, to ``(B, d)`` codewords."""
        k = min(self.k, points.shape[1])
        with torch.no_grad():
            indices = k_nearest(points, points, k)[1]
        neighbours = gather_points(points, indices.flatten(1)).unflatten(1, indices.shape[1:])
        centred = neighbours - neighbours.mean(2, keepdim=True)
        covariance = centred.mT @ centred / k
        local = self.features(torch.cat([points, covariance.flatten(2)], 2))
        local = self.graph(_neighbour_max(local, indices))
        return self.head(self.pool(_neighbour_max(local, indices)))


def _neighbour_max(features: Tensor, indices: Tensor) -> Tensor:
    """Return the maximum of ``(B, N, C)`` features over the ``(B, N, k)`` neighbours of points."""
    rows = gather_points(features, indices.flatten(1)).unflatten(1, indices.shape[1:])
    return rows.amax(2)


class MFoldingNet(nn.Module):
    """M-FoldingNet: an encoder, and a decoder that folds one grid per piece of the codeword.

    With one piece it is FoldingNet. The paper does not give the hidden layers of a folding; 2048
    and 144 match its model sizes best: 4.9, 3.3, 3.1, 2.9, 2.9, 2.8, 2.8 MB for M = 1, 4, 8, 16,
    32, 64, 128 at d = 128, compared with 4.7, 3.1, 2.9, 2.8, 2.8, 2.8, 2.8 MB in the paper.

    Args:
        n_points: default number of output points; the attribute may be changed at any time.
        pieces: M.
        codeword: size d of the codeword, a multiple of M.
        encoder: ``mlp``, the encoder of all nets in the paper, or ``graph``, FoldingNet's own.
        fold_channels: sizes of the hidden layers of each of the two foldings.

    Raises:
        UserError: an argument is out of range.
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
            raise UserError(f"n_points must be at least pieces={pieces}, got {n_points}.")
        self.n_points = n_points
        self.encoder: GraphEncoder | PointEncoder
        if encoder not in ENCODERS:
            raise UserError(f"encoder: unknown {encoder!r}.{did_you_mean(encoder, ENCODERS)}")
        if encoder == "graph":
            self.encoder = GraphEncoder(codeword)
        else:
            self.encoder = PointEncoder(codeword)
        self.decoder = FoldingDecoder(codeword, pieces, fold_channels)

    def forward(self, points: Tensor, n_points: int | None = None) -> Tensor:
        """Map ``(B, N, 3)`` points, any N, to ``(B, n, 3)``.

        Args:
            points: the sampled or the full cloud.
            n_points: n; None means the attribute ``n_points``.
        """
        return self.from_pooled(self.encoder(points), n_points)

    @property
    def pools_points(self) -> bool:
        """Whether the codeword follows from ``point_features``: not with the graph encoder."""
        return not isinstance(self.encoder, GraphEncoder)

    def point_features(self, points: Tensor) -> Tensor:
        """Return the features ``(B, N, d)`` whose maxima over points are the codeword.

        Raises:
            UserError: the encoder is ``graph``, whose features depend on neighbouring points.
        """
        if isinstance(self.encoder, GraphEncoder):
            raise UserError(
                "encoder must be mlp for what needs features of single points, got graph."
            )
        return self.encoder.point_features(points)

    def from_pooled(self, pooled: Tensor, n_points: int | None = None) -> Tensor:
        """Map codewords ``(B, d)`` to ``(B, n, 3)``; ``n_points`` as for ``forward``."""
        return self.decoder(pooled, n_points or self.n_points)
