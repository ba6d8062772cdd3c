"""Hashes of points and codes along a curve, in loops that numba compiles."""

# mypy: disable-error-code="no-untyped-def"

import numpy as np

from mops_lightning.ops.jit import float_bits, jit, jit_cached

FIRST, SECOND = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
"""The multipliers of SplitMix64."""

LOAD = 16
"""Bits of a table per key: one key in 32 is taken for a copy, and then compared."""


@jit
def _xor_shift(word, shift):
    return word ^ (word >> np.uint64(shift))


@jit
def _scramble(word):
    """Make every bit of the result depend on every bit of a word (SplitMix64's finalizer)."""
    word = _xor_shift(word, 30) * FIRST
    word = _xor_shift(word, 27) * SECOND
    return _xor_shift(word, 31)


@jit_cached
def point_keys(points, clouds, channels, seed):
    """Hash every point with the seed and with its cloud; see ``samplers.ordering.point_hashes``.

    Args:
        points: ``(B·N·C,)`` coordinates, one point after the other.
        clouds: B.
        channels: C.
        seed: uint64, mixed.

    Returns:
        ``(B·N,)`` uint64.
    """
    keys = np.empty(len(points) // channels, np.uint64)
    size = len(keys) // clouds
    for cloud in range(clouds):
        part = keys[cloud * size : (cloud + 1) * size]
        coordinates = points[cloud * size * channels : (cloud + 1) * size * channels]
        total = np.uint64(0)
        for i in range(size):
            key = seed
            for axis in range(channels):
                value = np.float64(coordinates[i * channels + axis]) + 0.0  # turns -0 into 0
                key = _xor_shift((key ^ np.uint64(float_bits(value))) * FIRST, 32)
            total += _xor_shift(key, 29) * SECOND
            part[i] = key
        for i in range(size):
            part[i] = _scramble(part[i] + total)
    return keys


@jit_cached
def perhaps_repeated(keys):
    """Return the indices of all keys ``(N,)`` uint64 that occur more than once, and a few others.

    A table with ``LOAD`` bits per key finds most first occurrences without a sort.
    """
    mask = np.uint64(7)
    while mask < LOAD * len(keys):
        mask = mask * np.uint64(2) + np.uint64(1)
    seen = np.zeros(np.int64(mask // np.uint64(8)) + 1, np.uint8)
    later, count = np.empty(len(keys), np.int64), 0
    for i in range(len(keys)):
        slot = np.int64(keys[i] & mask)
        bit = np.uint8(1 << (slot & 7))
        later[count] = i
        count += (seen[slot >> 3] & bit) != 0
        seen[slot >> 3] |= bit
    if count == 0:
        return later[:0]
    seen[:] = 0
    for i in later[:count]:
        slot = np.int64(keys[i] & mask)
        seen[slot >> 3] |= np.uint8(1 << (slot & 7))
    count = 0
    for i in range(len(keys)):
        slot = np.int64(keys[i] & mask)
        later[count] = i
        count += (seen[slot >> 3] & np.uint8(1 << (slot & 7))) != 0
    return later[:count]


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
                lowest, highest = min(lowest, part[3 * i + axis]), max(highest, part[3 * i + axis])
            low[axis] = lowest
            side = max(side, np.float64(highest) - np.float64(lowest))
        side = max(side, 2.2250738585072014e-308)
        for i in range(size):
            code = 0
            for axis in range(3):
                offset = np.float64(part[3 * i + axis]) - low[axis]
                cell = np.int64(offset / side * (2**21 - 1))
                code |= (spread[cell >> 11] << 33 | spread[cell & 2047]) << (2 - axis)
            codes[cloud * size + i] = code
    return codes
