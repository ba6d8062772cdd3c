"""Random order of the points of a cloud that depends on the seed and the cloud only.

With a stream of random numbers, the sample of a cloud would depend on the batch, the epoch and the
order of its points. Here, points are ordered by a hash of their coordinates, the seed and the whole
cloud.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.ops import kernel_order

WORD = 2**64
STEP = 0x9E3779B97F4A7C15  # 2⁶⁴ divided by the golden ratio, odd
FIRST, SECOND = 0xBF58476D1CE4E5B9, 0x94D049BB133111EB  # the multipliers of SplitMix64


def seeded_order(points: Tensor, seed: int) -> Tensor:
    """Return a random order of the points of every cloud.

    The resulting sequence of points does not depend on the order of the input, on the other clouds
    in the batch, or on whether the coordinates are given in float32 or float64. Copies of a point
    get independent positions; the order among them follows the input.

    Args:
        points: ``(B, N, C)`` floating point.
        seed: any integer.

    Returns:
        ``(B, N)`` int64 permutations.
    """
    keys = seeded_keys(points, seed)
    if keys.is_cpu:  # NumPy's vectorised sort is several times faster than torch's
        return torch.from_numpy(np.argsort(keys.numpy(), axis=1, kind="stable"))
    return keys.argsort(dim=1, stable=True)


def seeded_keys(points: Tensor, seed: int) -> Tensor:
    """Return the random keys ``(B, N)`` int64 whose order is ``seeded_order``."""
    if points.is_cpu:
        return torch.from_numpy(_compiled_keys(points, seed))
    keys = point_hashes(points.detach(), seed)
    values, order = keys.sort(dim=1, stable=True)
    equal = values[:, 1:] == values[:, :-1]
    if bool(equal.any()):
        place = torch.arange(points.shape[1], device=points.device).expand_as(order)
        begin = place.clone()
        begin[:, 1:].masked_fill_(equal, 0)
        copy = place - begin.cummax(1).values
        # First copies keep their keys, so that clouds without copies do not depend on the batch.
        values = torch.where(copy > 0, _scramble(values + copy * _signed(STEP)), values)
        keys = torch.empty_like(keys).scatter_(1, order, values)
    return keys


def smallest(keys: Tensor, m: int) -> Tensor:
    """Return the rows ``(B, m)`` of the m smallest keys ``(B, N)`` of every cloud, ascending."""
    if not keys.is_cpu or m == keys.shape[1]:
        return keys.argsort(dim=1, stable=True)[:, :m].contiguous()
    values = keys.numpy()
    rows = np.argpartition(values, m - 1, axis=1)[:, :m]
    order = np.argsort(np.take_along_axis(values, rows, 1), axis=1)
    return torch.from_numpy(np.take_along_axis(rows, order, 1))


def compiled_hashes(points: Tensor, seed: int) -> NDArray[np.uint64]:
    """Return the bits of ``point_hashes`` of clouds on a CPU, several times as fast."""
    given = points.detach()
    if given.dtype not in (torch.float32, torch.float64):
        given = given.float()
    coordinates = given.contiguous().numpy()
    clouds, size, channels = coordinates.shape
    word = np.uint64((seed * STEP + 1) % WORD)
    hashes: NDArray[np.uint64] = kernel_order.point_keys(
        coordinates.reshape(-1), clouds, channels, word
    )
    return hashes.reshape(clouds, size)


def _compiled_keys(points: Tensor, seed: int) -> NDArray[np.int64]:
    """Return the keys of clouds on a CPU, without a sort of all of them."""
    hashes = compiled_hashes(points, seed)
    size = hashes.shape[1]
    keys = hashes.reshape(-1)
    repeated = kernel_order.perhaps_repeated(keys)
    if len(repeated):
        order = np.lexsort((keys[repeated], repeated // size))  # stable: copies keep their order
        rows = repeated[order]
        values = keys[rows]
        starts = np.ones(len(rows), np.bool_)
        starts[1:] = (values[1:] != values[:-1]) | (rows[1:] // size != rows[:-1] // size)
        place = np.arange(len(rows))
        copy = (place - np.maximum.accumulate(np.where(starts, place, 0))).astype(np.uint64)
        later = copy > 0
        if later.any():
            words = (values[later] + copy[later] * np.uint64(STEP)).view(np.int64)
            keys[rows[later]] = _scramble(torch.from_numpy(words)).numpy().view(np.uint64)
    return keys.view(np.int64).reshape(hashes.shape)


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
    keys = torch.full_like(bits[..., 0], _signed(seed * STEP + 1))
    for axis in range(points.shape[2]):
        keys = _xor_shift(keys.bitwise_xor_(bits[..., axis]).mul_(_signed(FIRST)), 32)
    return _scramble(keys.add_(_xor_shift(keys, 29).mul_(_signed(SECOND)).sum(1, keepdim=True)))


def _scramble(keys: Tensor) -> Tensor:
    """Make every bit of the result depend on every bit of a key (the finalizer of SplitMix64)."""
    keys = _xor_shift(keys, 30).mul_(_signed(FIRST))
    keys = _xor_shift(keys, 27).mul_(_signed(SECOND))
    return _xor_shift(keys, 31)


def _xor_shift(keys: Tensor, shift: int) -> Tensor:
    """Return ``keys ^ (keys >> shift)`` with an unsigned shift."""
    return (keys >> shift).bitwise_and_(2 ** (64 - shift) - 1).bitwise_xor_(keys)


def _signed(word: int) -> int:
    """Return the int64 with the bits of ``word`` modulo 2⁶⁴."""
    word %= WORD
    return word - WORD if word >= WORD // 2 else word
