"""Point-to-plane ICP as a net without weights."""

import numpy as np
import torch
from torch import Tensor, nn

from mops_lightning.errors import UserError, check_at_least
from mops_lightning.ops.nearest import nearest
from mops_lightning.ops.normals import NEIGHBOURS, estimate_normals
from mops_lightning.ops.points import gather_points
from mops_lightning.ops.rigid import Motion, identity_motion, motion_of_vectors

DAMPING = 1e-6
"""Added to the diagonal of the normal equations, so that a sample that holds no pose has one."""


class PlaneICP(nn.Module):
    """Registers two clouds by point-to-plane ICP, from the identity.

    Chen and Medioni, "Object Modelling by Registration of Multiple Range Images", 1992: every
    source point is compared with the plane of the nearest target point, and a Gauss-Newton step
    follows. Gradients flow through the last step only, in which the correspondences are constant.

    Args:
        iterations: number of steps.
        max_distance: of corresponding points, in the clouds' unit.

    Raises:
        UserError: an argument is out of range.
    """

    def __init__(self, iterations: int = 20, max_distance: float = 0.3) -> None:
        super().__init__()
        check_at_least(1, iterations=iterations)
        if not 0 < max_distance < float("inf"):
            raise UserError(f"max_distance must be a number above 0, got {max_distance}.")
        self.iterations = iterations
        self.max_distance = max_distance

    def forward(self, source: Tensor, target: Tensor) -> Motion:
        """Return the motion from the source to the target.

        Args:
            source: ``(B, M, 3)``.
            target: ``(B, N, 3)``.
        """
        normals = surface_normals(target)
        total = identity_motion(source)
        with torch.no_grad():
            for _ in range(self.iterations - 1):
                total = self.step(total, source, target, normals)
        return self.step(total, source, target, normals)

    def step(self, motion: Motion, source: Tensor, target: Tensor, normals: Tensor) -> Motion:
        """Return a motion after one Gauss-Newton step.

        Args:
            motion: of the source.
            source: ``(B, M, 3)``.
            target: ``(B, N, 3)``.
            normals: ``(B, N, 3)`` of the target.
        """
        moved = motion.apply(source)
        with torch.no_grad():
            squared, rows = nearest(moved, target)
        across = gather_points(normals, rows)
        apart = moved - gather_points(target, rows)
        residuals = (apart * across).sum(2)
        turns = torch.linalg.cross(moved, across)
        levers = torch.cat([turns, across], 2)
        is_near = (squared.sqrt() <= self.max_distance).to(moved)
        step = weighted_step(levers.double(), residuals.double(), is_near.double())
        step = step.to(moved)
        turn = step[:, :3]
        shift = step[:, 3:]
        return motion_of_vectors(turn, shift).after(motion)


def weighted_step(levers: Tensor, residuals: Tensor, weights: Tensor) -> Tensor:
    """Return the step −(Σ w v vᵀ)⁻¹·Σ w v e ``(B, 6)`` of least squares.

    Args:
        levers: ``(B, M, 6)`` the vectors v: how residuals change with the pose.
        residuals: ``(B, M)`` the residuals e.
        weights: ``(B, M)`` the weights w, of at least 0.
    """
    weighted = levers * weights[..., None]
    damping = DAMPING * torch.eye(6, dtype=levers.dtype, device=levers.device)
    matrix = weighted.mT @ levers + damping
    pull = weighted.mT @ residuals[..., None]
    solution = torch.linalg.solve(matrix, pull)
    return -solution[..., 0]


@torch.no_grad()
def surface_normals(points: Tensor) -> Tensor:
    """Return estimated unit normals ``(B, N, 3)`` of clouds, of either sign."""
    clouds = points.double().cpu().numpy()
    normals = [estimate_normals(cloud, NEIGHBOURS) for cloud in clouds]
    return torch.from_numpy(np.stack(normals)).to(points)
