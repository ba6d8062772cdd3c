"""PCRNet: registration from the global features of two clouds.

Sarode et al., "PCRNet: Point Cloud Registration Network using PointNet Encoding", 2019; the task
net of the paper's section "Registration-oriented Downsampling".
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mops_lightning.channels import PointChannels, coordinates
from mops_lightning.errors import check_at_least
from mops_lightning.nets.layers import PointMLP, check_channels, linear_norm_relu
from mops_lightning.nets.max_pool import PointMaxPool
from mops_lightning.ops.rigid import Motion, identity_motion, move

HEAD_CHANNELS = (1024, 1024, 512, 512, 256)
"""Sizes of the hidden layers of the head."""


class PCRNet(nn.Module):
    """A PointNet shared by both clouds, and a head that predicts quaternion and translation.

    Pointwise layers of 64, 64, 64, 128 and 1024 channels and the maximum over points; then both
    global features are concatenated and pass layers of 1024, 1024, 512, 512, 256 and 7. There is no
    BatchNorm.

    Weights are initialised as by He et al. (ICCV 2015): without BatchNorm, the signal vanishes in
    eleven layers with PyTorch's smaller default weights, and the training stalls. The bias of the
    last layer starts at the identity.

    Args:
        iterations: number of passes. Each pass registers the source as moved by the passes before
            it, and the motions are composed. The paper uses 1, PCRNet's authors 8.
        feature_channels: sizes of the pointwise layers.
        point_channels: channels of the points, or their number; normals turn with the source.

    Raises:
        UserError: an argument is out of range.
    """

    def __init__(
        self,
        iterations: int = 1,
        feature_channels: Sequence[int] = (64, 64, 64, 128, 1024),
        point_channels: PointChannels | int = 0,
    ) -> None:
        super().__init__()
        self.point_channels = PointChannels.of(point_channels)
        check_at_least(1, iterations=iterations)
        check_channels("feature_channels", feature_channels, 2)
        self.iterations = iterations
        first = 3 + len(self.point_channels)
        *hidden, before, width = feature_channels
        self.features = PointMLP([first, *hidden, before], norm=False)
        self.pool = PointMaxPool(before, width, norm=False)
        self.head = linear_norm_relu([2 * width, *HEAD_CHANNELS], norm=False)
        self.motion = nn.Linear(HEAD_CHANNELS[-1], 7)
        for module in self.modules():
            if isinstance(module, nn.Linear) and module is not self.motion:
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                nn.init.zeros_(module.bias)
        with torch.no_grad():
            self.motion.bias.copy_(torch.eye(7)[0])

    def forward(self, source: Tensor, target: Tensor) -> Motion:
        """Return the motion from the source to the target.

        Args:
            source: ``(B, M, 3 + C)``, with the centroid near the origin.
            target: ``(B, M', 3 + C)``, with the centroid near the origin.
        """
        total = identity_motion(coordinates(source))
        of_target = None
        for _ in range(self.iterations):
            moved = source
            if of_target is not None:
                moved = move(source, total, self.point_channels)
            if of_target is None and source.shape == target.shape:
                both = self._global(torch.cat([moved, target]))
                of_source, of_target = both.chunk(2)
            else:
                of_source = self._global(moved)
                if of_target is None:
                    of_target = self._global(target)
            step = self._step(of_source, of_target, source)
            total = step.after(total)
        return total

    def _step(self, of_source: Tensor, of_target: Tensor, like: Tensor) -> Motion:
        """Return the motion of one pass, in the dtype of ``like``, from both global features."""
        hidden = self.head(torch.cat([of_source, of_target], 1))
        predicted = self.motion(hidden).to(like)
        quaternion = F.normalize(predicted[:, :4], dim=1)
        return Motion(quaternion, translation=predicted[:, 4:])

    def point_features(self, points: Tensor) -> Tensor:
        """Return the features ``(B, N, C)`` of one cloud whose maxima over points the head takes.

        With several iterations, the features of the source hold for the first iteration only.
        """
        return self.pool.values(self.features(points))

    def _global(self, points: Tensor) -> Tensor:
        return self.pool(self.features(points))
