"""A random order of a cloud's points that depends on the seed and the cloud alone.

A stream of random numbers would give a cloud another sample in another batch, in another epoch or
with its points in another order. Here every point is numbered by a hash of its coordinates, the
seed and the whole cloud, so its place in the order is the same wherever it stands.
"""

import torch
from torch import Tensor

WORD = 2**64
STEP = 0x9E3779B97F4A7C15  # 2⁶⁴ divided by the golden ratio, odd
FIRST, SECOND = 0xBF58476D1CE4E5B9, 0x94D049BB133111EB  # the multipliers of SplitMix64


def seeded_order(points: Tensor, seed: int) -> Tensor:
    """Put the points of every cloud into random order.

    Reordered clouds give the same points in the same order, a cloud in a batch what it gives
    alone, and float32 what the same numbers give in float64. Copies of a point are numbered, so
    that they do not stand together; which of them is which follows their place in the input.

    Args:
        points: ``(B, N, C)`` floating point.
        seed: any integer; others give other orders.

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
        # First ones keep their keys: clouds without copies must not notice their neighbours.
        values = torch.where(copy > 0, _scramble(values + copy * _signed(STEP)), values)
        order = order.gather(1, values.argsort(dim=1, stable=True))
    return order


def point_hashes(points: Tensor, seed: int) -> Tensor:
    """Hash every point with the seed and with its cloud.

    The cloud enters as the sum of its points' first hashes, which no reordering changes: else
    points that many clouds share, such as the origin, would be chosen in all of them or in none.

    Args:
        points: ``(B, N, C)`` floating point.
        seed: any integer.

    Returns:
        ``(B, N)`` int64, all 64 bits random; equal points of one cloud have equal hashes.
    """
    # int64 products wrap on every device, which is what a hash wants; + 0.0 turns -0 into 0.
    bits = (points.double() + 0.0).view(torch.int64)
    keys = torch.full_like(bits[..., 0], _signed(seed * STEP + 1))
    for axis in range(points.shape[2]):
        keys = _xor_shift(keys.bitwise_xor_(bits[..., axis]).mul_(_signed(FIRST)), 32)
    return _scramble(keys.add_(_xor_shift(keys, 29).mul_(_signed(SECOND)).sum(1, keepdim=True)))


def _scramble(keys: Tensor) -> Tensor:
    """Let every bit of a key change every bit of the result (the finish of SplitMix64)."""
    keys = _xor_shift(keys, 30).mul_(_signed(FIRST))
    keys = _xor_shift(keys, 27).mul_(_signed(SECOND))
    return _xor_shift(keys, 31)


def _xor_shift(keys: Tensor, shift: int) -> Tensor:
    """Return ``keys ^ (keys >> shift)`` with the zeros of an unsigned shift."""
    return (keys >> shift).bitwise_and_(2 ** (64 - shift) - 1).bitwise_xor_(keys)


def _signed(word: int) -> int:
    """Return the int64 with the bits of ``word`` modulo 2⁶⁴."""
    word %= WORD
    return word - WORD if word >= WORD // 2 else word
