"""Farthest points on a GPU in one launch. Triton comes with torch's builds for CUDA."""

import torch
import triton
import triton.language as tl
from torch import Tensor

from mops_lightning.ops.nearest import nearest
from mops_lightning.ops.points import gather_points, to_planes

LARGEST = 16384
"""Most points of a cloud: a block keeps them all in its registers."""

POINTS_PER_WARP = 256
MOST_WARPS = 32

SHARE = 1 - 12 * torch.finfo(torch.float32).eps
"""Share of the largest distance from which a point could be the farthest: twice the largest
rounding error of three coordinates, and the rounding of the product."""

SLACK = 4 * torch.finfo(torch.float32).tiny
"""The same for squares that underflow."""


@triton.jit
def _farthest(  # type: ignore[no-untyped-def]
    planes,
    distances,
    rows,
    counts,
    clouds,
    size,
    steps,
    share: tl.constexpr,
    slack: tl.constexpr,
    largest: tl.constexpr,
    block: tl.constexpr,
):
    """Fill up the rows of the block's cloud; planes are ``(3, clouds, size)``."""
    cloud = tl.program_id(0)
    slots = tl.arange(0, block)
    inside = slots < size
    xs = planes + cloud * size
    ys = xs + clouds * size
    zs = ys + clouds * size
    chosen = rows + cloud * steps
    x = tl.load(xs + slots, mask=inside, other=0.0)
    y = tl.load(ys + slots, mask=inside, other=0.0)
    z = tl.load(zs + slots, mask=inside, other=0.0)
    left = tl.load(distances + cloud * size + slots, mask=inside, other=-1.0)
    for step in range(tl.load(counts + cloud), steps):
        least = tl.maximum(tl.minimum(tl.max(left, 0), largest) * share - slack, 0.0)
        near = left >= least
        row = tl.argmax(left, 0)
        if tl.sum(near.to(tl.int32), 0) > 1:
            # Several points could be the farthest: float64 distances decide.
            tl.debug_barrier()  # the rows that other threads have stored
            square = tl.full((block,), float("inf"), tl.float64)
            for earlier in range(step):
                other = tl.load(chosen + earlier)
                dx = x.to(tl.float64) - tl.load(xs + other).to(tl.float64)
                dy = y.to(tl.float64) - tl.load(ys + other).to(tl.float64)
                dz = z.to(tl.float64) - tl.load(zs + other).to(tl.float64)
                square = tl.minimum(square, dx * dx + dy * dy + dz * dz)
            row = tl.argmax(tl.where(near, square, -1.0), 0)
        # NaN makes any slot the maximum, also one outside.
        row = tl.minimum(row, size - 1)
        tl.store(chosen + step, row)
        dx = x - tl.load(xs + row)
        dy = y - tl.load(ys + row)
        dz = z - tl.load(zs + row)
        left = tl.minimum(left, dx * dx + dy * dy + dz * dz)
        left = tl.where(slots == row, -1.0, left)


def farthest(points: Tensor, given: Tensor, counts: Tensor, m: int) -> Tensor | None:
    """Choose farthest points; arguments and result as for ``ops.fps.farthest``.

    None where another form must be used: for more than ``LARGEST`` points, other than three
    coordinates, or float64.
    """
    clouds, size, channels = points.shape
    if size > LARGEST or channels != 3 or points.dtype == torch.float64:
        return None
    exact = points.detach().float()
    slot = torch.arange(given.shape[1], device=points.device)
    known = torch.where(slot < counts[:, None], given, given[:, :1])
    distances, _ = nearest(exact, gather_points(exact, known))
    distances.scatter_(1, known, -1.0)
    rows = torch.empty(clouds, m, dtype=torch.int64, device=points.device)
    rows[:, : known.shape[1]] = known
    block = max(triton.next_power_of_2(size), 32)
    warps = min(max(block // POINTS_PER_WARP, 1), MOST_WARPS)
    with torch.cuda.device_of(points):
        _farthest[(clouds,)](
            to_planes(exact),
            distances.contiguous(),
            rows,
            counts.contiguous(),
            clouds,
            size,
            m,
            SHARE,
            SLACK,
            torch.finfo(torch.float32).max,
            block,
            num_warps=warps,
            enable_fp_fusion=False,  # float64 squares are rounded as on a CPU
        )
    return rows
