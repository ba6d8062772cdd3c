"""The auto-encoder that the paper reconstructs small clouds with, and its encoder for all others.

Achlioptas et al., "Learning Representations and Generative Models for 3D Point Clouds", ICML 2018;
the task net of the paper's section "Reconstruction of small-scale point clouds".
"""

from collections.abc import Sequence

from torch import Tensor, nn

from mops_lightning.errors import UserError
from mops_lightning.nets.pointnet import PointMaxPool, PointMLP, check_channels, linear_norm_relu


class PointEncoder(nn.Module):
    """Per-point layers with BatchNorm and ReLU, and the maximum over points: the codeword.

    Args:
        codeword: its size d, the last layer's.
        channels: sizes of the layers before it.

    Raises:
        UserError: a layer has no channels.
    """

    def __init__(self, codeword: int = 128, channels: Sequence[int] = (64, 128, 128, 256)) -> None:
        super().__init__()
        if not channels or min(codeword, *channels) < 1:
            raise UserError(
                "task.net.encoder: codeword and channels must be at least 1, got "
                f"{codeword} and {list(channels)}."
            )
        self.codeword = codeword
        self.features = PointMLP([3, *channels])
        self.pool = PointMaxPool(channels[-1], codeword)

    def forward(self, points: Tensor) -> Tensor:
        """Map ``(B, N, 3)`` points to ``(B, d)`` codewords, any N."""
        return self.pool(self.features(points))


class AutoEncoder(nn.Module):
    """Encoder, and a decoder of linear layers that emits all coordinates of n points at once.

    Args:
        n_points: n, how many points are emitted; fixed once and for all.
        codeword: size d of the codeword.
        encoder_channels: sizes of the encoder's layers before it.
        decoder_channels: sizes of the decoder's hidden layers, with ReLU and without BatchNorm.

    Raises:
        UserError: a layer has no channels, or there are no points.
    """

    def __init__(
        self,
        n_points: int = 1024,
        codeword: int = 128,
        encoder_channels: Sequence[int] = (64, 128, 128, 256),
        decoder_channels: Sequence[int] = (256, 256),
    ) -> None:
        super().__init__()
        if n_points < 1:
            raise UserError(f"task.net.n_points must be at least 1, got {n_points}.")
        check_channels("task.net.decoder_channels", decoder_channels)
        self.n_points = n_points
        self.encoder = PointEncoder(codeword, encoder_channels)
        self.decoder = nn.Sequential(
            *linear_norm_relu([codeword, *decoder_channels], norm=False),
            nn.Linear(decoder_channels[-1], 3 * n_points),
        )

    def forward(self, points: Tensor, n_points: int | None = None) -> Tensor:
        """Map ``(B, N, 3)`` points, any N, to ``(B, n, 3)``.

        Args:
            points: the sampled or the full cloud.
            n_points: None or the net's own number.

        Raises:
            UserError: another number of points is asked for.
        """
        if n_points not in (None, self.n_points):
            raise UserError(
                f"task/net=autoencoder emits the {self.n_points} points that it was trained for, "
                f"not {n_points}. Train one with task.net.n_points={n_points}, or take "
                "task/net=mfoldingnet, whose number of points can change."
            )
        return self.decoder(self.encoder(points)).unflatten(1, (-1, 3))
