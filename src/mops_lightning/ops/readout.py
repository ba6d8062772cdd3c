"""Readouts of generated points: the matched and the completed set.

Paper section "Efficient Regression of the Sampled Set", last paragraph.
"""

import torch
from torch import Tensor

from mops_lightning.channels import coordinates
from mops_lightning.errors import UserError
from mops_lightning.ops.fps import farthest_point_fill
from mops_lightning.ops.nearest import nearest
from mops_lightning.ops.points import gather_points

READOUTS = ("generated", "matched", "completed")


def select(
    points: Tensor, generated: Tensor, readout: str, weight: Tensor | None = None
) -> tuple[Tensor, Tensor | None]:
    """Return the points that a user takes as the sampled set.

    Args:
        points: ``(B, N, 3 + C)`` the clouds.
        generated: ``(B, M, 3 + C)`` the points that a sampler generated for them.
        readout: one of ``READOUTS``.
        weight: see ``complete``.

    Returns:
        ``(B, M, 3 + C)``, and their rows ``(B, M)`` in the clouds, or None for generated points.
    """
    if readout == "generated":
        return generated, None
    rows = match(generated, points)
    if readout == "completed":
        rows = complete(rows, points, weight)
    return gather_points(points, rows), rows


def match(generated: Tensor, points: Tensor) -> Tensor:
    """Match every generated point to its nearest input point.

    Args:
        generated: ``(B, M, 3)``, or with channels, which distances leave out.
        points: ``(B, N, 3)``, or with channels.

    Returns:
        ``(B, M)`` int64 rows of ``points``, possibly with repetitions; the lowest row in case of
        ties.

    Raises:
        UserError: the shapes do not match, or a cloud is empty.

    Examples:
        >>> import torch
        >>> from mops_lightning import match
        >>> points = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [5, 0, 0]]])
        >>> match(torch.tensor([[[0.9, 0, 0], [1.2, 0, 0]]]), points)
        tensor([[1, 1]])
    """
    queries = coordinates(generated.detach())
    _, rows = nearest(queries, coordinates(points.detach()))
    return rows


def unique_count(indices: Tensor) -> Tensor:
    """Count the distinct indices of every cloud.

    Args:
        indices: ``(B, M)`` int64, non-negative.

    Returns:
        ``(B,)`` int64, from 1 to M.
    """
    return _is_first(indices).sum(1)


def complete(indices: Tensor, points: Tensor, weight: Tensor | None = None) -> Tensor:
    """Remove repeated matches and fill up by farthest point sampling from the matched points.

    Args:
        indices: ``(B, M)`` int64 rows of ``points``, from ``match``.
        points: ``(B, N, 3)``, N ≥ M, or with channels, which distances leave out.
        weight: ``(B, N)`` of the points in the filling up, see ``farthest_point_sample``.

    Returns:
        ``(B, M)`` int64, all distinct: the matched rows in the order of their first occurrence,
        followed by rows from farthest point sampling.

    Raises:
        UserError: a shape or dtype is wrong, or M is larger than N.

    Examples:
        >>> import torch
        >>> from mops_lightning import complete
        >>> points = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [5, 0, 0]]])
        >>> complete(torch.tensor([[1, 1]]), points)
        tensor([[1, 2]])
    """
    have_shape = indices.ndim == 2 and points.ndim == 3
    fits = have_shape and len(points) == len(indices) and indices.shape[1] <= points.shape[1]
    if not fits or indices.dtype != torch.int64:
        raise UserError(
            "indices must be int64 (B, M) and points (B, N, 3), with the same B and M ≤ N, got "
            f"{indices.dtype} {tuple(indices.shape)} and {tuple(points.shape)}."
        )
    first = _is_first(indices)
    # A stable sort moves first occurrences to the front and keeps their order.
    order = first.logical_not().byte().argsort(dim=1, stable=True)
    firsts_in_front = indices.gather(1, order)
    return farthest_point_fill(coordinates(points), firsts_in_front, first.sum(1), weight)


def _is_first(indices: Tensor) -> Tensor:
    """Return a ``(B, M)`` mask of the first occurrence of every index."""
    value, order = indices.sort(dim=1, stable=True)
    is_new = torch.ones_like(indices, dtype=torch.bool)
    is_new[:, 1:] = value[:, 1:] != value[:, :-1]
    return torch.empty_like(is_new).scatter_(1, order, is_new)
