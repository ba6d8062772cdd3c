"""Farthest point sampling (Eldar et al., IEEE TIP 1997), from a start point or a given subset."""

from contextlib import suppress

import torch
from torch import Tensor

from mops_lightning.errors import UserError
from mops_lightning.ops import compiled
from mops_lightning.ops.farthest import LEAST_FACTOR
from mops_lightning.ops.points import gather_points, to_planes


def farthest_point_sample(
    points: Tensor,
    m: int,
    start: int | Tensor = 0,
    weight: Tensor | None = None,
) -> Tensor:
    """Choose m points, each as far as possible from the points chosen before it.

    Eldar et al., "The Farthest Point Strategy for Progressive Image Sampling", IEEE TIP 1997.

    Args:
        points: ``(B, N, C)``.
        m: number of points to choose, 1 ≤ m ≤ N.
        start: index of the first point, one for all clouds or ``(B,)``.
        weight: ``(B, N)`` finite, not all 0: the distance of a point is multiplied by its weight,
            as in the weighted centre problem (Dyer and Frieze, Operations Research Letters 1985)
            and in S-FPS (Chen et al., "SASA", AAAI 2022).

    Returns:
        ``(B, m)`` distinct int64 indices in the order of choice; the first k are the result for
        m = k. The choice is that of float64 arithmetic on the given numbers, the lowest index in
        case of ties, on every device.

    Raises:
        UserError: ``points`` has another shape, or ``m`` or ``start`` is out of range.

    Examples:
        >>> import torch
        >>> from mops_lightning import farthest_point_sample
        >>> line = torch.tensor([[[0.0], [1.0], [2.0], [9.0]]])  # (B, N, C)
        >>> farthest_point_sample(line, 3)
        tensor([[0, 3, 2]])
    """
    if points.ndim != 3:
        raise UserError(f"points must have shape (B, N, C), got {tuple(points.shape)}.")
    clouds, n = points.shape[:2]
    if not 1 <= m <= n:
        raise UserError(f"m must be between 1 and the number of points N={n}, got {m}.")
    outside = (start < 0) | (start >= n)
    if isinstance(outside, Tensor):
        outside = bool(outside.any())
    if outside:
        raise UserError(f"start must be between 0 and N-1={n - 1}, got {start}.")
    first = torch.as_tensor(start, device=points.device).expand(clouds)
    one_each = torch.ones_like(first)
    return farthest(points, first[:, None], one_each, m, weight)


def farthest_point_fill(
    points: Tensor,
    indices: Tensor,
    counts: Tensor,
    weight: Tensor | None = None,
) -> Tensor:
    """Fill up subsets of every cloud by farthest point sampling.

    Args:
        points: ``(B, N, C)``.
        indices: ``(B, M)`` int64, M ≤ N; the first ``counts[b]`` entries of row b are the given
            points, all distinct. The remaining entries are replaced.
        counts: ``(B,)`` int64, 1 ≤ counts ≤ M.
        weight: as for ``farthest_point_sample``.

    Returns:
        ``(B, M)`` int64, all distinct: the given points, followed by points that are each farthest
        from all points before them.
    """
    wanted = indices.shape[1]
    missing = wanted - int(counts.min())
    if missing == 0:
        return indices
    return farthest(points, indices, counts, wanted, weight)


@torch.no_grad()
def farthest(
    points: Tensor,
    given: Tensor,
    counts: Tensor,
    m: int,
    weight: Tensor | None = None,
    ranks: Tensor | None = None,
) -> Tensor:
    """Fill up rows of every cloud to m by farthest points.

    Args:
        points: ``(B, N, C)``.
        given: ``(B, G)`` int64, G ≤ m; the first ``counts[b]`` of cloud b are the given rows.
        counts: ``(B,)`` int64, from 1 to G.
        m: number of rows, at most N.
        weight: as for ``farthest_point_sample``.
        ranks: ``(B, N)`` int64: the lowest rank wins a tie; None: the lowest row does.

    Returns:
        ``(B, m)`` int64.
    """
    factors = None
    if weight is not None:
        exact = weight.double()
        relative = exact / exact.amax(1, keepdim=True)
        factors = relative.square().clamp_min(LEAST_FACTOR)
    if ranks is not None:  # in the order of the ranks, the lowest row wins a tie
        order = ranks.argsort(dim=1, stable=True)
        ordered = gather_points(points, order)
        if factors is not None:
            factors = factors.gather(1, order)
        given = order.argsort(1).gather(1, given)
        places = _on_device(ordered, given, counts, m, factors)
        return order.gather(1, places)
    rows = compiled.farthest(points, given, counts, m, factors)
    if rows is None:
        return _on_device(points, given, counts, m, factors)
    return rows


def _on_device(
    points: Tensor, given: Tensor, counts: Tensor, m: int, factors: Tensor | None
) -> Tensor:
    """Choose farthest points of points on a GPU, or of points that are not finite."""
    if points.is_cuda and not torch.compiler.is_compiling():
        if factors is None:
            with suppress(ImportError):  # a build of torch without Triton
                from mops_lightning.ops import triton_fps

                rows = triton_fps.farthest(points, given, counts, m)
                if rows is not None:
                    return rows
        host_factors = None
        if factors is not None:
            host_factors = factors.cpu()
        host_points = points.detach().cpu()
        rows = compiled.farthest(host_points, given.cpu(), counts.cpu(), m, host_factors)
        if rows is not None:
            return rows.to(points.device)
    return farthest_in_steps(points, given, counts, m, factors)


def farthest_in_steps(
    points: Tensor,
    given: Tensor,
    counts: Tensor,
    m: int,
    factors: Tensor | None = None,
) -> Tensor:
    """Choose farthest points in torch; arguments as for ``farthest``."""
    slot = torch.arange(given.shape[1], device=points.device)
    is_given = slot < counts[:, None]
    known = torch.where(is_given, given, given[:, :1])
    planes = to_planes(points.detach().double())
    distances = torch.full_like(planes[0], torch.inf)
    for column in range(known.shape[1]):
        _lower(distances, planes, known[:, column : column + 1])
    added = []
    for _ in range(m - int(counts.min())):
        gains = distances
        if factors is not None:
            gains = distances * factors
        row = gains.argmax(1, keepdim=True)
        added.append(row)
        _lower(distances, planes, row)
    if not added:
        return known
    # Clouds that lack fewer points write the surplus beyond column m, which is then cut off.
    added_rows = torch.cat(added, 1)
    filled = torch.cat([known, added_rows], 1)
    columns = torch.arange(len(added), device=points.device)
    places = counts[:, None] + columns
    return filled.scatter_(1, places, added_rows)[:, :m]


def _lower(distances: Tensor, planes: Tensor, rows: Tensor) -> None:
    """Lower squared distances ``(B, N)`` to those from rows ``(B, 1)``, which are marked by -1."""
    total = torch.zeros_like(distances)
    for plane in planes:
        difference = plane - plane.gather(1, rows)
        total += difference.square_()  # two steps: a fused multiply-add would round once
    torch.minimum(distances, total, out=distances)
    distances.scatter_(1, rows, -1.0)
