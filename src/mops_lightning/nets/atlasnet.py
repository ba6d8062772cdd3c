"""AtlasNet: independent decoders, one per surface patch.

Groueix et al., "A Papier-Mâché Approach to Learning 3D Surface Generation", CVPR 2018; a baseline
in the paper's section "Reconstruction of large-scale point clouds".
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from mops_lightning.channels import PointChannels
from mops_lightning.errors import UserError, check_at_least
from mops_lightning.nets.autoencoder import PointEncoder, Reconstructor
from mops_lightning.nets.foldingnet import REACH, square_grid
from mops_lightning.nets.layers import check_channels, linear_norm_relu


class Patch(nn.Module):
    """Decoder of one patch: lifts 2-D points, adds the codeword, and maps the sum to 3-D.

    Args:
        codeword: size d of the codeword.
        channels: sizes of the layers after the lifting, with BatchNorm and ReLU.
    """

    def __init__(self, codeword: int, channels: Sequence[int]) -> None:
        super().__init__()
        self.lift = nn.Linear(2, codeword)
        hidden = linear_norm_relu([codeword, *channels])
        self.layers = nn.Sequential(*hidden, nn.Linear(channels[-1], 3))

    def forward(self, codeword: Tensor, square: Tensor) -> Tensor:
        """Map ``(B, d)`` codewords and ``(B or 1, g, 2)`` points of a square to ``(B, g, 3)``."""
        hidden = self.lift(square) + codeword[:, None]
        rows = self.layers(hidden.flatten(0, 1))
        return rows.unflatten(0, hidden.shape[:2])


class AtlasNet(Reconstructor):
    """The paper's encoder, and M patches without shared weights.

    Patches map random points of a square in training, and a regular grid in evaluation.

    Args:
        n_points: default number of output points; the attribute may be changed at any time.
        pieces: M, the number of patches.
        codeword: size d of the codeword.
        patch_channels: sizes of the layers of every patch.
        point_channels: channels of the points that the encoder sees, or their number.

    Raises:
        UserError: an argument is out of range.
    """

    def __init__(
        self,
        n_points: int = 1024,
        pieces: int = 4,
        codeword: int = 128,
        patch_channels: Sequence[int] = (1024, 512, 512),
        point_channels: PointChannels | int = 0,
    ) -> None:
        super().__init__()
        check_at_least(1, pieces=pieces)
        if n_points < pieces:
            raise UserError(f"n_points must be at least pieces={pieces}, got {n_points}.")
        check_channels("patch_channels", patch_channels)
        self.n_points = n_points
        self.encoder = PointEncoder(codeword, point_channels=point_channels)
        patches = [Patch(codeword, patch_channels) for _ in range(pieces)]
        self.patches = nn.ModuleList(patches)

    def from_pooled(self, pooled: Tensor, n_points: int | None = None) -> Tensor:
        """Map codewords ``(B, d)`` to ``(B, n, 3)``; ``n_points`` as for ``forward``."""
        n = n_points or self.n_points
        size = -(-n // len(self.patches))
        patches = []
        for patch in self.patches:
            if self.training:
                shape = (len(pooled), size, 2)
                square = torch.rand(shape, device=pooled.device, dtype=pooled.dtype)
                square = (square - 0.5) * 2 * REACH
            else:
                square = square_grid(size).to(pooled)[None]
            patches.append(patch(pooled, square))
        points = torch.stack(patches, 2).flatten(1, 2)
        return points[:, :n]
