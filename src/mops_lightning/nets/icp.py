"""Iterative closest points: the classical yardstick that learned registration is measured by."""

import numpy as np
import torch
from torch import Tensor, nn

from mops_lightning.errors import UserError
from mops_lightning.ops.rigid import Motion, quaternion_from_matrix


class ICP(nn.Module):
    """Point-to-point ICP (Besl and McKay, 1992) by trimesh, from the identity.

    It has no weights and lets no gradient through: nothing can be trained under it, but any sampler
    can be tested with it.

    Args:
        max_iterations: of closest points and best motion, 1 or more.
        threshold: stop where the mean squared distance improves by less than this.

    Raises:
        UserError: a number is out of range.
    """

    differentiable = False

    def __init__(self, max_iterations: int = 20, threshold: float = 1e-5) -> None:
        super().__init__()
        if max_iterations < 1:
            raise UserError(f"task.net.max_iterations must be at least 1, got {max_iterations}.")
        if not 0 <= threshold < np.inf:
            raise UserError(f"task.net.threshold must not be negative, got {threshold}.")
        self.max_iterations = max_iterations
        self.threshold = threshold

    @torch.no_grad()
    def forward(self, source: Tensor, target: Tensor) -> Motion:
        """Return the motion that takes ``(B, M, 3)`` sources to ``(B, M', 3)`` targets."""
        pairs = zip(_numpy(source), _numpy(target), strict=True)
        matrices = torch.from_numpy(np.stack([self._align(a, b) for a, b in pairs]))
        rotation, translation = matrices[:, :3, :3], matrices[:, :3, 3]
        return Motion(
            quaternion_from_matrix(rotation).to(source), translation.contiguous().to(source)
        )

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
