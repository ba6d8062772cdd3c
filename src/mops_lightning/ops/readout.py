"""From generated points to input points: matched and completed sets.

Paper, end of section "Efficient Regression of the Sampled Set".
"""

import torch
from torch import Tensor

from mops_lightning.errors import UserError
from mops_lightning.ops.fps import farthest_point_fill
from mops_lightning.ops.nearest import nearest


def match(generated: Tensor, points: Tensor) -> Tensor:
    """Replace every generated point by its nearest input point.

    Args:
        generated: ``(B, M, 3)``.
        points: ``(B, N, 3)``.

    Returns:
        ``(B, M)`` int64 rows of ``points``; several may be equal. Where several input points are
        equally near, the lowest row.
    """
    return nearest(generated.detach(), points.detach())[1]


def unique_count(indices: Tensor) -> Tensor:
    """Count the different indices of every cloud.

    Args:
        indices: ``(B, M)`` int64, not negative.

    Returns:
        ``(B,)`` int64, from 1 to M.
    """
    return _is_first(indices).sum(1)


def complete(indices: Tensor, points: Tensor) -> Tensor:
    """Make matched points unique and fill them up by farthest point sampling from them.

    Args:
        indices: ``(B, M)`` int64 rows of ``points``, from ``match``.
        points: ``(B, N, 3)``, N ≥ M.

    Returns:
        ``(B, M)`` int64, all different: the matched rows in the order of their first occurrence,
        then each time the input point that is farthest from all rows before it.

    Raises:
        UserError: there are fewer points than rows to fill.
    """
    if indices.shape[1] > points.shape[1]:
        raise UserError(
            f"indices must have at most as many columns as there are points, N={points.shape[1]}, "
            f"got M={indices.shape[1]}: a set of M different points cannot be had."
        )
    first = _is_first(indices)
    # A stable sort of "seen before" keeps the first occurrences in their order, and in front.
    order = first.logical_not().byte().argsort(dim=1, stable=True)
    return farthest_point_fill(points, indices.gather(1, order), first.sum(1))


def _is_first(indices: Tensor) -> Tensor:
    """Mark, in ``(B, M)``, every index that no column before it holds."""
    value, order = indices.sort(dim=1, stable=True)
    new = torch.ones_like(indices, dtype=torch.bool)
    new[:, 1:] = value[:, 1:] != value[:, :-1]
    return torch.empty_like(new).scatter_(1, order, new)
