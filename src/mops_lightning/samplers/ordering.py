"""Random order of the points of a cloud that depends on the seed and the cloud only.

With a stream of random numbers, the sample of a cloud would depend on the batch, the epoch and the
order of its points. Here, points are ordered by a hash of their coordinates, the seed and the whole
cloud.
"""

import torch
from torch import Tensor

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
        order = order.gather(1, values.argsort(dim=1, stable=True))
    return order


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
