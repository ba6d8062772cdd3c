"""Keys of points, by which a seed orders them, in loops that numba compiles.

A key is a hash of the point's coordinates, of the seed and of the whole cloud; ``ops.keys`` says
how. ``ops.kernel_farthest`` computes keys, too. Coordinates are read in blocks, which stay in the
fastest cache while each axis is visited.
"""

# mypy: disable-error-code="no-untyped-def"

import math

import numpy as np

from mops_lightning.ops.jit import bits_float, float_bits, jit, jit_cached

FIRST = np.uint64(0xBF58476D1CE4E5B9)
SECOND = np.uint64(0x94D049BB133111EB)
"""The multipliers of SplitMix64."""

STEP = np.uint64(0x9E3779B97F4A7C15)
"""2⁶⁴ divided by the golden ratio, odd."""

ONE = np.uint64(1)

BLOCK = 512
"""Number of points of a block."""

SUM_BITS = 51
"""Bits of the integers of which a mean is computed."""

SHIFT = 1.5 * 2.0**52
"""Added to a number below 2⁵¹, it leaves an integer in the lower bits."""

FILTER_KEYS = 8
"""Keys per word of 64 bits of the first filter for copies: about one key in 60 passes it."""


@jit
def to_planes(points, channels):
    """Return coordinates one channel after the other, and the largest absolute value.

    The latter is NaN or infinite if any coordinate is.
    """
    size = len(points) // channels
    planes = np.empty(len(points), points.dtype)
    top = float_bits(points.dtype.type(0))
    if channels == 3:  # a constant stride is vectorised
        x = planes[:size]
        y = planes[size : 2 * size]
        z = planes[2 * size :]
        for i in range(size):
            x[i] = points[3 * i]
            y[i] = points[3 * i + 1]
            z[i] = points[3 * i + 2]
    else:
        for axis in range(channels):
            for i in range(size):
                planes[axis * size + i] = points[channels * i + axis]
    for i in range(len(planes)):
        top = max(top, float_bits(abs(planes[i])))
    return planes, np.float64(bits_float(top, planes[0]))


@jit
def measure_sphere(planes, channels, largest, sphere):
    """Write the centre and the radius of a cloud's unit sphere to ``(C + 1,)`` numbers.

    The mean is that of integers, whose sum does not depend on the order of the points.
    """
    size = len(planes) // channels
    exponent = SUM_BITS - math.frexp(largest)[1]
    unit = math.ldexp(1.0, min(exponent, 1000))
    shift_bits = float_bits(SHIFT)
    for axis in range(channels):
        line = planes[axis * size : (axis + 1) * size]
        high = low = np.int64(0)
        for begin in range(0, size, BLOCK):
            part = line[begin : begin + BLOCK]
            total = np.int64(0)
            for i in range(len(part)):
                steps = np.float64(part[i]) * unit
                total += float_bits(steps + SHIFT) - shift_bits
            high += total >> 32
            low += total & np.int64(0xFFFFFFFF)
        sum_of_steps = np.float64(high) * 2.0**32 + np.float64(low)
        sphere[axis] = sum_of_steps / size / unit
    squares = np.empty(BLOCK)
    largest_bits = float_bits(0.0)
    for begin in range(0, size, BLOCK):
        part = squares[: min(BLOCK, size - begin)]
        for axis in range(channels):
            line = planes[axis * size + begin : axis * size + begin + BLOCK]
            centre = sphere[axis]
            if axis == 0:
                for i in range(len(part)):
                    offset = line[i] - centre
                    part[i] = offset * offset
            else:
                for i in range(len(part)):
                    offset = line[i] - centre
                    part[i] += offset * offset
        for i in range(len(part)):
            largest_bits = max(largest_bits, float_bits(part[i]))
    radius = math.sqrt(bits_float(largest_bits, 0.0))
    sphere[channels] = radius if radius > 0 else 1.0


@jit
def _xor_shift(word, shift):
    return word ^ (word >> np.uint64(shift))


@jit
def _scramble(word):
    """Make every bit of the result depend on every bit of a word (SplitMix64's finalizer)."""
    word = _xor_shift(word, 30) * FIRST
    word = _xor_shift(word, 27) * SECOND
    return _xor_shift(word, 31)


@jit
def _with_value(key, value):
    """Return a key that depends on one more coordinate."""
    value_bits = np.uint64(float_bits(value + 0.0))  # -0 becomes 0
    return _xor_shift((key ^ value_bits) * FIRST, 32)


@jit
def write_keys(planes, channels, word, sphere, keys):
    """Write the keys ``(N,)`` uint64 of a cloud.

    Args:
        planes: ``(C·N,)`` coordinates, one channel after the other.
        channels: C.
        word: the seed, mixed.
        sphere: ``(C + 1,)`` from ``measure_sphere``, to hash the points of the unit sphere in
            float32; or ``(0,)``, to hash the given coordinates.
        keys: where to write.
    """
    size = len(keys)
    total = np.uint64(0)
    for begin in range(0, size, BLOCK):
        part = keys[begin : begin + BLOCK]
        for i in range(len(part)):
            part[i] = word
        for axis in range(channels):
            line = planes[axis * size + begin : axis * size + begin + BLOCK]
            if len(sphere):
                centre = sphere[axis]
                radius = sphere[channels]
                for i in range(len(part)):
                    scaled = np.float32((line[i] - centre) / radius)
                    part[i] = _with_value(part[i], np.float64(scaled))
            else:
                for i in range(len(part)):
                    value = np.float64(line[i])
                    part[i] = _with_value(part[i], value)
        for i in range(len(part)):
            total += _xor_shift(part[i], 29) * SECOND
    for i in range(size):
        keys[i] = _scramble(keys[i] + total)


@jit
def _bits_of(key):
    """Return two bits of a word."""
    low_bits = key & np.uint64(63)
    next_bits = key >> np.uint64(6) & np.uint64(63)
    return ONE << low_bits | ONE << next_bits


@jit
def _filter(number):
    """Return an empty filter for a number of keys: its length is a power of two."""
    words = 8
    while words * FILTER_KEYS < number:
        words *= 2
    return np.zeros(words, np.uint64)


@jit
def _change_copies(keys):
    """Give every later occurrence of a key ``(N,)`` a key of its own, in place.

    Two filters find the keys that may occur again, and a few others, without a sort.
    """
    seen = _filter(len(keys))
    mask = np.uint64(len(seen) - 1)
    later = np.empty(len(keys), np.int64)
    count = 0
    for row in range(len(keys)):
        key = keys[row]
        at = np.int64(key >> np.uint64(40) & mask)
        bits = _bits_of(key)
        word = seen[at]
        seen[at] = word | bits
        if word & bits == bits:
            later[count] = row
            count += 1
    if count == 0:
        return
    wanted = _filter(4 * count)
    mask = np.uint64(len(wanted) - 1)
    for k in range(count):
        key = keys[later[k]]
        at = np.int64(key >> np.uint64(40) & mask)
        wanted[at] |= _bits_of(key)
    count = 0
    for row in range(len(keys)):
        key = keys[row]
        at = np.int64(key >> np.uint64(40) & mask)
        bits = _bits_of(key)
        if wanted[at] & bits == bits:
            later[count] = row
            count += 1
    _change_copies_among(keys, later, count)


@jit
def _change_copies_among(keys, rows, count):
    """Change later occurrences of keys in some of the rows, which ascend."""
    slots = 16
    while slots < 2 * count:
        slots *= 2
    mask = np.uint64(slots - 1)
    first = np.empty(slots, np.uint64)
    copies = np.zeros(slots, np.int64)
    for k in range(count):
        key = keys[rows[k]]
        slot = np.int64(key >> np.uint64(20) & mask)
        while copies[slot] and first[slot] != key:
            slot = (slot + 1) & (slots - 1)
        if copies[slot]:
            number = np.uint64(copies[slot])
            keys[rows[k]] = _scramble(key + number * STEP)
        first[slot] = key
        copies[slot] += 1


@jit
def ranks_of(planes, channels, largest, word, in_sphere, distinct):
    """Return the keys ``(N,)`` of one cloud as int64; arguments as for the functions above."""
    keys = np.empty(len(planes) // channels, np.uint64)
    sphere = np.empty(0)
    if in_sphere:
        sphere = np.empty(channels + 1)
        measure_sphere(planes, channels, largest, sphere)
    write_keys(planes, channels, word, sphere, keys)
    if distinct:
        _change_copies(keys)
    return keys.view(np.int64)


@jit_cached
def keys_of(points, clouds, channels, word, in_sphere, distinct):
    """Return the keys ``(B·N,)`` int64 of finite clouds.

    Args:
        points: ``(B·N·C,)`` coordinates, one point after the other.
        clouds: B.
        channels: C.
        word: the seed, mixed.
        in_sphere: whether to hash the points of the unit sphere.
        distinct: whether later copies of a point get keys of their own.
    """
    keys = np.empty(len(points) // channels, np.int64)
    size = len(keys) // clouds
    for cloud in range(clouds):
        start = cloud * size
        stop = start + size
        cloud_points = points[start * channels : stop * channels]
        planes, largest = to_planes(cloud_points, channels)
        ranks = ranks_of(planes, channels, largest, word, in_sphere, distinct)
        for i in range(size):  # the assignment of a slice takes seconds to compile
            keys[start + i] = ranks[i]
    return keys


@jit_cached
def are_finite(values):
    """Return whether all of ``(N,)`` values are finite."""
    top = float_bits(values.dtype.type(0))
    for i in range(len(values)):
        top = max(top, float_bits(abs(values[i])))
    return bits_float(top, values[0]) < np.inf


@jit_cached
def spheres_of(points, clouds, channels):
    """Return the centres and radii ``(B·(C + 1),)`` of finite clouds; arguments as above."""
    length = channels + 1
    spheres = np.empty(clouds * length)
    size = len(points) // clouds
    for cloud in range(clouds):
        cloud_points = points[cloud * size : (cloud + 1) * size]
        planes, largest = to_planes(cloud_points, channels)
        sphere = spheres[cloud * length : (cloud + 1) * length]
        measure_sphere(planes, channels, largest, sphere)
    return spheres
