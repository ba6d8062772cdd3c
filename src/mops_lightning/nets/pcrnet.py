"""PCRNet: a rigid motion from the global features of two clouds.

Sarode et al., "PCRNet: Point Cloud Registration Network using PointNet Encoding", 2019; the task
net of the paper's section "Registration-oriented Downsampling".
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mops_lightning.errors import UserError
from mops_lightning.nets.pointnet import PointMaxPool, PointMLP, check_channels, linear_norm_relu
from mops_lightning.ops.rigid import Motion, identity_motion


class PCRNet(nn.Module):
    """Two clouds through one PointNet, and a head that answers quaternion and translation.

    Layers 64, 64, 64, 128, 1024 per point, maximum over points, both results side by side through
    1024, 1024, 512, 512, 256 to 7 numbers. There is no BatchNorm.

    Weights start as He et al. (ICCV 2015) draw them: without BatchNorm the usual smaller ones let
    the signal fade on its way through eleven layers, and training does not get off the ground. The
    last bias starts at the identity.

    Args:
        iterations: passes; each moves the source by what the ones before it found, and the motions
            add up. 1 is the paper's, 8 the authors' own.
        feature_channels: sizes of the per-point layers.
        head_channels: sizes of the hidden layers of the head.

    Raises:
        UserError: there is no pass, or a layer has no channels.
    """

    def __init__(
        self,
        iterations: int = 1,
        feature_channels: Sequence[int] = (64, 64, 64, 128, 1024),
        head_channels: Sequence[int] = (1024, 1024, 512, 512, 256),
    ) -> None:
        super().__init__()
        if iterations < 1:
            raise UserError(f"task.net.iterations must be at least 1, got {iterations}.")
        check_channels("task.net.feature_channels", feature_channels, 2)
        check_channels("task.net.head_channels", head_channels)
        self.iterations = iterations
        self.features = PointMLP([3, *feature_channels[:-1]], norm=False)
        self.pool = PointMaxPool(feature_channels[-2], feature_channels[-1], norm=False)
        self.head = linear_norm_relu([2 * feature_channels[-1], *head_channels], norm=False)
        self.motion = nn.Linear(head_channels[-1], 7)
        for module in self.modules():
            if isinstance(module, nn.Linear) and module is not self.motion:
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                nn.init.zeros_(module.bias)
        with torch.no_grad():
            self.motion.bias.copy_(torch.eye(7)[0])

    def forward(self, source: Tensor, target: Tensor) -> Motion:
        """Return the motion that takes the source to the target.

        Args:
            source: ``(B, M, 3)``, centroid near the origin.
            target: ``(B, M', 3)``, the same.
        """
        total = identity_motion(source)
        aim = None
        for _ in range(self.iterations):
            moved = total.apply(source) if aim is not None else source
            if aim is None and source.shape == target.shape:
                mine, aim = self._global(torch.cat([moved, target])).chunk(2)
            else:
                mine = self._global(moved)
                aim = self._global(target) if aim is None else aim
            answer = self.motion(self.head(torch.cat([mine, aim], 1))).to(source)
            step = Motion(F.normalize(answer[:, :4], dim=1), answer[:, 4:])
            total = step.after(total)
        return total

    def _global(self, points: Tensor) -> Tensor:
        return self.pool(self.features(points))
