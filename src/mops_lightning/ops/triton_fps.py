"""Farthest points on a GPU in one launch. Triton comes with torch's builds for CUDA."""

import torch
import triton
import triton.language as tl
from torch import Tensor

from mops_lightning.ops.points import to_planes

LARGEST = 16384
"""Most points of a cloud: a block keeps them all in its registers."""

POINTS_PER_WARP, MOST_WARPS = 256, 32


@triton.jit
def _farthest(planes, distances, rows, clouds, size, steps, block: tl.constexpr):  # type: ignore[no-untyped-def]
    """Choose ``steps`` points of the block's cloud; planes are ``(3, clouds, size)``."""
    cloud = tl.program_id(0)
    slots = tl.arange(0, block)
    inside = slots < size
    xs = planes + cloud * size
    ys = xs + clouds * size
    zs = ys + clouds * size
    x = tl.load(xs + slots, mask=inside, other=0.0)
    y = tl.load(ys + slots, mask=inside, other=0.0)
    z = tl.load(zs + slots, mask=inside, other=0.0)
    left = tl.load(distances + cloud * size + slots, mask=inside, other=-1.0)
    for step in range(steps):
        # NaN makes any slot the maximum, also one outside.
        row = tl.minimum(tl.argmax(left, 0), size - 1)
        tl.store(rows + cloud * steps + step, row)
        dx = x - tl.load(xs + row)
        dy = y - tl.load(ys + row)
        dz = z - tl.load(zs + row)
        left = tl.minimum(left, dx * dx + dy * dy + dz * dz)
        left = tl.where(slots == row, -1.0, left)


def farthest(points: Tensor, distances: Tensor, steps: int) -> Tensor | None:
    """Choose farthest points; arguments and result as for ``compiled.farthest``.

    Distances are rounded as on a CPU, so that the result is the same. None where the torch form
    must be used: for more than ``LARGEST`` points, other than three coordinates, or float64.
    """
    clouds, size, channels = points.shape
    if size > LARGEST or channels != 3 or distances.dtype != torch.float32:
        return None
    rows = torch.empty(clouds, steps, dtype=torch.int64, device=points.device)
    block = max(triton.next_power_of_2(size), 32)
    warps = min(max(block // POINTS_PER_WARP, 1), MOST_WARPS)
    with torch.cuda.device_of(points):
        _farthest[(clouds,)](
            to_planes(points.float()),
            distances.contiguous(),
            rows,
            clouds,
            size,
            steps,
            block,
            num_warps=warps,
            enable_fp_fusion=False,  # a·b + c with one rounding is not what a CPU computes
        )
    return rows
