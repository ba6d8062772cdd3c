"""The auto-encoder for small clouds, and the encoder of all reconstruction nets.

Achlioptas et al., "Learning Representations and Generative Models for 3D Point Clouds", ICML 2018;
the task net of the paper's section "Reconstruction of small-scale point clouds".
"""

from collections.abc import Sequence

from torch import Tensor, nn

from mops_lightning.channels import PointChannels
from mops_lightning.errors import UserError, check_at_least
from mops_lightning.nets.layers import PointMLP, check_channels, linear_norm_relu
from mops_lightning.nets.max_pool import PointMaxPool

DECODER_CHANNELS = (256, 256)
"""Sizes of the decoder's hidden layers, with ReLU and without BatchNorm."""


class PointEncoder(nn.Module):
    """Pointwise layers with BatchNorm and ReLU, then the maximum over points: the codeword.

    Args:
        codeword: size d of the codeword, the last layer.
        channels: sizes of the layers before it.
        point_channels: channels of the points, or their number.

    Raises:
        UserError: a layer has no channels.
    """

    def __init__(
        self,
        codeword: int = 128,
        channels: Sequence[int] = (64, 128, 128, 256),
        point_channels: PointChannels | int = 0,
    ) -> None:
        super().__init__()
        self.point_channels = PointChannels.of(point_channels)
        check_at_least(1, codeword=codeword)
        check_channels("channels", channels)
        self.codeword = codeword
        input_channels = 3 + len(self.point_channels)
        self.features = PointMLP([input_channels, *channels])
        self.pool = PointMaxPool(channels[-1], codeword)

    def forward(self, points: Tensor) -> Tensor:
        """Map ``(B, N, 3 + C)`` points to ``(B, d)`` codewords, any N."""
        return self.pool(self.features(points))

    def point_features(self, points: Tensor) -> Tensor:
        """Return the features ``(B, N, d)`` whose maxima over points are the codeword."""
        return self.pool.values(self.features(points))


class Reconstructor(nn.Module):
    """Base of the reconstruction nets: an encoder, and ``from_pooled``, the decoder.

    Attributes:
        encoder: gives the codeword.
        n_points: default number of output points.
    """

    encoder: PointEncoder
    n_points: int

    @property
    def point_channels(self) -> PointChannels:
        """The channels that the encoder sees; they are not reconstructed."""
        return self.encoder.point_channels

    def forward(self, points: Tensor, n_points: int | None = None) -> Tensor:
        """Map ``(B, N, 3 + C)`` points, any N, to ``(B, n, 3)``.

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
        raise NotImplementedError


class AutoEncoder(Reconstructor):
    """Encoder, and a decoder of linear layers with all 3n coordinates as output.

    Args:
        n_points: n, the fixed number of output points.
        codeword: size d of the codeword.
        encoder_channels: sizes of the encoder's layers before the codeword.
        point_channels: channels of the points that the encoder sees, or their number.

    Raises:
        UserError: an argument is out of range.
    """

    def __init__(
        self,
        n_points: int = 1024,
        codeword: int = 128,
        encoder_channels: Sequence[int] = (64, 128, 128, 256),
        point_channels: PointChannels | int = 0,
    ) -> None:
        super().__init__()
        check_at_least(1, n_points=n_points)
        check_channels("encoder_channels", encoder_channels)
        self.n_points = n_points
        self.encoder = PointEncoder(codeword, encoder_channels, point_channels)
        hidden = linear_norm_relu([codeword, *DECODER_CHANNELS], norm=False)
        last = nn.Linear(DECODER_CHANNELS[-1], 3 * n_points)
        self.decoder = nn.Sequential(*hidden, last)

    def from_pooled(self, pooled: Tensor, n_points: int | None = None) -> Tensor:
        """Map codewords ``(B, d)`` to ``(B, n, 3)``.

        Raises:
            UserError: ``n_points`` is neither None nor the net's own.
        """
        if n_points not in (None, self.n_points):
            raise UserError(
                f"n_points must be {self.n_points}, the size this AutoEncoder was made for, got "
                f"{n_points}. Train one for {n_points} points, or use MFoldingNet "
                "(task/net=mfoldingnet), which has a variable number of points."
            )
        return self.decoder(pooled).unflatten(1, (-1, 3))
