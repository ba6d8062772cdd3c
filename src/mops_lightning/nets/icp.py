"""Iterative closest point (ICP), the classical baseline for registration."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from mops_lightning.ops.rigid import Motion


class ICP(nn.Module):
    """Point-to-point ICP (Besl and McKay, 1992) from trimesh, starting at the identity.

    It has no weights and passes no gradients: it cannot train a sampler, but test any.
    """

    differentiable = False

    @torch.no_grad()
    def forward(self, source: Tensor, target: Tensor) -> Motion:
        """Return the motion from ``(B, M, 3)`` sources to ``(B, M', 3)`` targets."""
        pairs = zip(_numpy(source), _numpy(target), strict=True)
        matrices = torch.from_numpy(np.stack([_align(a, b) for a, b in pairs]))
        scalar_last = Rotation.from_matrix(matrices[:, :3, :3].numpy()).as_quat(canonical=True)
        quaternion = torch.from_numpy(scalar_last).roll(1, 1)
        return Motion(quaternion.to(source), matrices[:, :3, 3].contiguous().to(source))


def _align(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    from trimesh.registration import icp

    # Up to 20 iterations, until the mean squared distance improves by less than 1e-5.
    return np.asarray(icp(source, target, reflection=False, scale=False)[0])


def _numpy(points: Tensor) -> np.ndarray:
    return points.detach().cpu().double().numpy()
