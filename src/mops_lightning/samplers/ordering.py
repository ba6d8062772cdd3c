"""Random order of the points of a cloud that depends on the seed and the cloud only.

With a stream of random numbers, the sample of a cloud would depend on the batch, the epoch and the
order of its points. Here, points are ordered by a hash of their coordinates, the seed and the whole
cloud.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.ops import keys
from mops_lightning.ops.keys import STEP, WORD, SeededOrder
from mops_lightning.ops.points import distance_dtype

SUM_BITS = 51
"""Bits of the integers of which a mean is computed."""

FIRST = 0xBF58476D1CE4E5B9
SECOND = 0x94D049BB133111EB
"""Multipliers of SplitMix64."""


def seeded_order(points: Tensor, seed: int, in_sphere: bool = False) -> Tensor:
    """Return a random order of the points of every cloud.

    The resulting sequence of points does not depend on the order of the input, on the other clouds
    in the batch, or on whether the coordinates are given in float32 or float64. Copies of a point
    get independent positions; the order among them follows the input.

    Args:
        points: ``(B, N, C)`` floating point.
        seed: any integer.
        in_sphere: see ``ops.keys.SeededOrder``.

    Returns:
        ``(B, N)`` int64 permutations.
    """
    random = seeded_keys(points, seed, in_sphere)
    if random.is_cpu:  # NumPy's vectorised sort is several times faster than torch's
        order = np.argsort(random.numpy(), axis=1, kind="stable")
        return torch.from_numpy(order)
    return random.argsort(dim=1, stable=True)


def seeded_keys(points: Tensor, seed: int, in_sphere: bool = False) -> Tensor:
    """Return the random keys ``(B, N)`` int64 whose order is ``seeded_order``."""
    order = SeededOrder(seed, in_sphere)
    return _on_its_device(points, order, keys.seeded_keys, _keys_on_device)


def seeded_hashes(points: Tensor, seed: int, in_sphere: bool = False) -> Tensor:
    """Return random keys ``(B, N)`` int64 as ``seeded_keys``, but one key for all copies."""
    order = SeededOrder(seed, in_sphere)
    return _on_its_device(points, order, keys.point_hashes, point_hashes)


def _on_its_device(
    points: Tensor,
    order: SeededOrder,
    in_loops: Callable[[NDArray[Any], SeededOrder], NDArray[np.int64]],
    in_torch: Callable[[Tensor, int], Tensor],
) -> Tensor:
    """Compute keys by the compiled loops on a CPU, in torch elsewhere."""
    given = points.detach()
    if given.is_cpu:
        numbers = given.to(distance_dtype(given)).numpy()
        return torch.from_numpy(in_loops(numbers, order))
    if order.in_sphere:
        given = in_unit_sphere(given)
    return in_torch(given, order.seed)


def _keys_on_device(points: Tensor, seed: int) -> Tensor:
    hashes = point_hashes(points, seed)
    values, order = hashes.sort(dim=1, stable=True)
    is_copy = values[:, 1:] == values[:, :-1]
    if bool(is_copy.any()):
        numbers = torch.arange(points.shape[1], device=points.device)
        place = numbers.expand_as(order)
        first = place.clone()
        first[:, 1:].masked_fill_(is_copy, 0)
        number_of_copy = place - first.cummax(1).values
        # First copies keep their keys, so that clouds without copies do not depend on the batch.
        steps = number_of_copy * _signed(STEP)
        scrambled = _scramble(values + steps)
        values = torch.where(number_of_copy > 0, scrambled, values)
        hashes = torch.empty_like(hashes).scatter_(1, order, values)
    return hashes


def in_unit_sphere(points: Tensor) -> Tensor:
    """Return clouds ``(B, N, C)`` in the unit sphere, float32, as ``ops.keys`` hashes them."""
    exact = points.double()
    centred = exact - exact_mean(exact)
    squares = torch.zeros_like(exact[..., :1])
    for axis in range(points.shape[2]):
        along = centred[..., axis : axis + 1]
        squares += along.square()
    radius = squares.amax(1, keepdim=True).sqrt()
    radius = torch.where(radius > 0, radius, 1.0)
    return (centred / radius).float()


def exact_mean(points: Tensor) -> Tensor:
    """Return the means ``(B, 1, C)`` of float64 points, which do not depend on their order.

    They are means of integers of 51 bits.
    """
    largest = points.abs().amax((1, 2), keepdim=True)
    exponent = SUM_BITS - torch.frexp(largest).exponent
    units = torch.ldexp(torch.ones_like(largest), exponent)
    scaled = points * units.clamp_max(2.0**1000)
    whole = scaled.round().long()
    # The sum of all 51 bits would exceed 64 bits.
    high_bits = whole >> 26
    low_bits = whole & (2**26 - 1)
    high = high_bits.sum(1, keepdim=True).double()
    low = low_bits.sum(1, keepdim=True).double()
    total = high * 2.0**26 + low
    return total / points.shape[1] / units


def smallest(keys: Tensor, m: int) -> Tensor:
    """Return the rows ``(B, m)`` of the m smallest keys ``(B, N)`` of every cloud, ascending."""
    if not keys.is_cpu or m == keys.shape[1]:
        sorted_rows = keys.argsort(dim=1, stable=True)
        return sorted_rows[:, :m].contiguous()
    values = keys.numpy()
    partition = np.argpartition(values, m - 1, axis=1)
    rows = partition[:, :m]
    keys_of_rows = np.take_along_axis(values, rows, 1)
    order = np.argsort(keys_of_rows, axis=1)
    ordered_rows = np.take_along_axis(rows, order, 1)
    return torch.from_numpy(ordered_rows)


def point_hashes(points: Tensor, seed: int) -> Tensor:
    """Hash every point with the seed and with its cloud.

    The cloud enters as the sum of the first hashes of its points, which is independent of their
    order. Without it, points that many clouds share, such as the origin, would be chosen in all of
    these clouds or in none.

    Args:
        points: ``(B, N, C)`` floating point.
        seed: any integer.

    Returns:
        ``(B, N)`` int64 with 64 random bits; equal points of a cloud have equal hashes.
    """
    # int64 products wrap on every device, as the hash requires; + 0.0 turns -0 into 0.
    bits = (points.double() + 0.0).view(torch.int64)
    start = _signed(seed * STEP + 1)
    keys = torch.full_like(bits[..., 0], start)
    for axis in range(points.shape[2]):
        keys = keys.bitwise_xor_(bits[..., axis])
        keys = keys.mul_(_signed(FIRST))
        keys = _xor_shift(keys, 32)
    words = _xor_shift(keys, 29).mul_(_signed(SECOND))
    of_cloud = words.sum(1, keepdim=True)
    return _scramble(keys.add_(of_cloud))


def _scramble(keys: Tensor) -> Tensor:
    """Make every bit of the result depend on every bit of a key (the finalizer of SplitMix64)."""
    keys = _xor_shift(keys, 30).mul_(_signed(FIRST))
    keys = _xor_shift(keys, 27).mul_(_signed(SECOND))
    return _xor_shift(keys, 31)


def _xor_shift(keys: Tensor, shift: int) -> Tensor:
    """Return ``keys ^ (keys >> shift)`` with an unsigned shift."""
    low_bits = 2 ** (64 - shift) - 1
    shifted = (keys >> shift).bitwise_and_(low_bits)
    return shifted.bitwise_xor_(keys)


def _signed(word: int) -> int:
    """Return the int64 with the bits of ``word`` modulo 2⁶⁴."""
    word %= WORD
    if word >= WORD // 2:
        return word - WORD
    return word
