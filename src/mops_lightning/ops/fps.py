"""Farthest point sampling (Eldar et al., IEEE TIP 1997), from a start point or a given subset."""

from contextlib import suppress

import torch
from torch import Tensor

from mops_lightning.errors import UserError
from mops_lightning.ops import compiled
from mops_lightning.ops.nearest import nearest
from mops_lightning.ops.points import cloud_sizes, distance_dtype, gather_points, to_planes

LEAST_FACTOR = 1e-200
"""Least squared weight: products of a chosen point, whose distance is -1, must be below 0."""


def farthest_point_sample(
    points: Tensor, m: int, start: int | Tensor = 0, weight: Tensor | None = None
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
        ``(B, m)`` distinct int64 indices in the order of choice, the lowest index in case of ties;
        the first k are the result for m = k.

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
    if outside if isinstance(outside, bool) else bool(outside.any()):
        raise UserError(f"start must be between 0 and N-1={n - 1}, got {start}.")
    first = torch.as_tensor(start, device=points.device).expand(clouds)
    dtype = distance_dtype(points)
    distances = points.new_full((clouds, n), torch.finfo(dtype).max, dtype=dtype)
    return _farthest(points, distances.scatter_(1, first[:, None], torch.inf), m, weight)


def farthest_point_fill(
    points: Tensor, indices: Tensor, counts: Tensor, weight: Tensor | None = None
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
    slot = torch.arange(wanted, device=indices.device)
    chosen = torch.where(slot < counts[:, None], indices, indices[:, :1])
    distinct = chosen[:, : int(counts.max())]
    distances, _ = nearest(points.detach(), gather_points(points.detach(), distinct))
    distances = distances.to(distance_dtype(points)).scatter_(1, chosen, -1.0)
    added = _farthest(points, distances, missing, weight)
    # Clouds that lack fewer points write the surplus beyond column M, which is then cut off.
    filled = torch.cat([chosen, added], 1)
    return filled.scatter_(1, counts[:, None] + slot[:missing], added)[:, :wanted]


@torch.no_grad()
def _farthest(
    points: Tensor, distances: Tensor, steps: int, weight: Tensor | None = None
) -> Tensor:
    """Choose farthest points; arguments and result as in ``compiled.farthest``."""
    factors = None
    if weight is not None:
        relative = weight.double() / weight.double().amax(1, keepdim=True)
        factors = relative.square().clamp_min(LEAST_FACTOR)
    rows = compiled.farthest(points, steps, distances, factors)
    if rows is None and factors is None and points.is_cuda and not torch.compiler.is_compiling():
        with suppress(ImportError):  # a build of torch without Triton
            from mops_lightning.ops import triton_fps

            rows = triton_fps.farthest(points, distances, steps)
    return farthest_in_steps(points, distances, steps, factors) if rows is None else rows


def farthest_in_steps(
    points: Tensor, distances: Tensor, steps: int, factors: Tensor | None = None
) -> Tensor:
    """Choose farthest points in torch, for GPUs; arguments as for ``compiled.farthest``."""
    planes = to_planes(points.to(distances.dtype))
    distances, differences = distances.clone(), torch.empty_like(planes)
    chosen = []
    for _ in range(steps):
        gains = distances if factors is None else distances * factors
        index = gains.argmax(1, keepdim=True)
        chosen.append(index)
        distances.scatter_(1, index, -1.0)
        torch.sub(planes, planes.gather(2, index.expand(len(planes), -1, -1)), out=differences)
        total, *others = differences
        total.mul_(total)
        for other in others:
            total.addcmul_(other, other)
        torch.minimum(distances, total, out=distances)
    return torch.cat(chosen, 1)


def fps(
    x: Tensor,
    batch: Tensor | None = None,
    ratio: float | Tensor = 0.5,
    random_start: bool = True,
    batch_size: int | None = None,
) -> Tensor:
    """Choose farthest points of flat clouds: a replacement for ``torch_geometric.nn.fps``.

    Signature and result are those of torch_cluster's ``fps``. Random starts are drawn by torch, so
    that ``torch.manual_seed`` repeats them. Where a cloud has fewer different points than are
    chosen, copies are chosen instead of the same row again.

    Args:
        x: ``(P, C)`` points of all clouds, or ``(P,)`` numbers.
        batch: ``(P,)`` the cloud of every point, ascending from 0; None: one cloud.
        ratio: share of the points to choose, 0 < ratio ≤ 1: ⌈ratio · n⌉ of a cloud's n points; a
            tensor holds one for all clouds, or one for each.
        random_start: start from a random point of every cloud instead of its first point.
        batch_size: number of clouds; None: as many as ``batch`` has.

    Returns:
        Rows of ``x``, int64, cloud by cloud, in the order of choice. With ``(B, N, C)`` points as
        ``x.flatten(0, 1)`` and ⌈ratio · N⌉ = M they are ``(B, M)``, flattened.

    Raises:
        UserError: an argument has a wrong shape or value.

    Examples:
        >>> import torch
        >>> from mops_lightning import fps
        >>> square = torch.tensor([[-1.0, -1], [-1, 1], [1, -1], [1, 1]])
        >>> fps(square, torch.tensor([0, 0, 0, 0]), ratio=0.5, random_start=False)
        tensor([0, 3])
    """
    if not isinstance(x, Tensor) or x.ndim == 0 or len(x) == 0:
        shape = tuple(getattr(x, "shape", ()))
        raise UserError(f"x must be a tensor (P, C) with P ≥ 1, got {type(x).__name__} {shape}.")
    if not bool(x.isfinite().all()):
        raise UserError("x must be finite, got NaN or infinity.")
    counts = torch.tensor([len(x)]) if batch is None else cloud_sizes(len(x), batch)
    if batch_size is not None and batch_size < len(counts):
        raise UserError(f"batch_size must be at least {len(counts)}, got {batch_size}.")
    points = x.detach().reshape(len(x), -1)
    share = torch.as_tensor(ratio, dtype=points.dtype).cpu()  # torch_cluster rounds as here
    if not bool(((share > 0) & (share <= 1)).all()) or share.numel() not in (1, len(counts)):
        raise UserError(f"ratio must be above 0 and at most 1, one or one per cloud, got {ratio}.")
    sizes = (counts.float() * share).ceil().long()
    starts = torch.zeros_like(counts)
    if random_start:
        starts = torch.randint(2**62, counts.shape) % counts.clamp_min(1)
    begins = counts.cumsum(0) - counts
    if len(counts.unique()) == len(sizes.unique()) == 1:
        clouds = points.reshape(len(counts), int(counts[0]), -1)
        rows = farthest_point_sample(clouds, int(sizes[0]), starts.to(x.device))
        return (rows + begins[:, None].to(x.device)).flatten()
    numbers = zip(*(part.tolist() for part in (sizes, starts, begins)), strict=True)
    parts = zip(points.split(counts.tolist()), numbers, strict=True)
    return torch.cat(
        [
            farthest_point_sample(cloud[None], m, start)[0] + begin
            for cloud, (m, start, begin) in parts
            if m
        ]
    )
