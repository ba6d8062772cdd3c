"""Iterative closest point (ICP), the classical baseline for registration."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from mops_lightning.errors import UserError
from mops_lightning.ops.rigid import Motion


class ICP(nn.Module):
    """Point-to-point ICP (Besl and McKay, 1992) from trimesh, starting at the identity.

    It has no weights and passes no gradients: it cannot train a sampler, but test any.

    Args:
        max_iterations: largest number of iterations, at least 1.
        threshold: ICP stops when the mean squared distance improves by less than this value, in
            squared units of the coordinates.

    Raises:
        UserError: an argument is out of range.
    """

    differentiable = False

    def __init__(self, max_iterations: int = 20, threshold: float = 1e-5) -> None:
        super().__init__()
        if max_iterations < 1:
            raise UserError(f"max_iterations must be at least 1, got {max_iterations}.")
        if not 0 <= threshold < np.inf:
            raise UserError(f"threshold must be a number of at least 0, got {threshold}.")
        self.max_iterations = max_iterations
        self.threshold = threshold

    @torch.no_grad()
    def forward(self, source: Tensor, target: Tensor) -> Motion:
        """Return the motion from ``(B, M, 3)`` sources to ``(B, M', 3)`` targets."""
        pairs = zip(_numpy(source), _numpy(target), strict=True)
        matrices = torch.from_numpy(np.stack([self._align(a, b) for a, b in pairs]))
        scalar_last = Rotation.from_matrix(matrices[:, :3, :3].numpy()).as_quat(canonical=True)
        quaternion = torch.from_numpy(scalar_last).roll(1, 1)
        return Motion(quaternion.to(source), matrices[:, :3, 3].contiguous().to(source))

    def _align(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        from trimesh.registration import icp

        matrix, _, _ = icp(
            source,
            target,
            threshold=self.threshold,
            max_iterations=self.max_iterations,
            reflection=False,
            scale=False,
        )
        return np.asarray(matrix)


def _numpy(points: Tensor) -> np.ndarray:
    return points.detach().cpu().double().numpy()
