"""Codes along a curve, in loops that numba compiles."""

# mypy: disable-error-code="no-untyped-def"

import numpy as np

from mops_lightning.ops.jit import jit_cached


@jit_cached
def morton_codes(points, clouds, spread):
    """Return the places of points on a Morton curve; see ``samplers.serial``.

    Args:
        points: ``(B·N·3,)`` coordinates, one point after the other.
        clouds: B.
        spread: ``(2048,)`` int64: every number of 11 bits with two zeros after every bit.

    Returns:
        ``(B·N,)`` int64.
    """
    codes = np.empty(len(points) // 3, np.int64)
    size = len(codes) // clouds
    low = np.empty(3)
    for cloud in range(clouds):
        part = points[3 * cloud * size : 3 * (cloud + 1) * size]
        side = 0.0
        for axis in range(3):
            lowest = highest = part[axis]
            for i in range(size):
                coordinate = part[3 * i + axis]
                lowest = min(lowest, coordinate)
                highest = max(highest, coordinate)
            low[axis] = lowest
            extent = np.float64(highest) - np.float64(lowest)
            side = max(side, extent)
        side = max(side, 2.2250738585072014e-308)
        for i in range(size):
            code = 0
            for axis in range(3):
                offset = np.float64(part[3 * i + axis]) - low[axis]
                cell = np.int64(offset / side * (2**21 - 1))
                high_bits = spread[cell >> 11] << 33
                low_bits = spread[cell & 2047]
                code |= (high_bits | low_bits) << (2 - axis)
            codes[cloud * size + i] = code
    return codes
