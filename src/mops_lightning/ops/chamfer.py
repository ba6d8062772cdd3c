"""Chamfer distance between point clouds."""

from torch import Tensor

from mops_lightning.ops.nearest import nearest


def chamfer_distance(points: Tensor, others: Tensor) -> Tensor:
    """Return the squared chamfer distance: the sum of the mean over both directions.

    CD(P, Q) = 1/|P| Σ_p min_q ‖p − q‖² + 1/|Q| Σ_q min_p ‖q − p‖². Memory does not grow with
    |P|·|Q|; gradients flow to both clouds through the nearest points.

    Args:
        points: ``(B, N, 3)`` clouds P.
        others: ``(B, M, 3)`` clouds Q.

    Returns:
        ``(B,)`` in squared units of the coordinates.

    Raises:
        UserError: the shapes do not match, or a cloud is empty.

    Examples:
        >>> import torch
        >>> from mops_lightning import chamfer_distance
        >>> chamfer_distance(torch.zeros(1, 4, 3), torch.ones(1, 2, 3))
        tensor([6.])
    """
    return nearest(points, others)[0].mean(1) + nearest(others, points)[0].mean(1)
