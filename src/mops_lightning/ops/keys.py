"""Random order of the points of a cloud that depends on the seed and the cloud only; no torch.

With a stream of random numbers, the sample of a cloud would depend on the batch, the epoch and the
order of its points. Here, points are ordered by keys: a hash of their coordinates, the seed and the
whole cloud.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mops_lightning.ops import kernel_keys

WORD = 2**64
STEP = int(kernel_keys.STEP)

Array = NDArray[Any]


class SeededOrder(NamedTuple):
    """The order of a cloud's points by ascending keys.

    Attributes:
        seed: any integer.
        in_sphere: hash the points as they are in the unit sphere, in float32, so that the order
            does not depend on the unit of the coordinates, up to rounding.
    """

    seed: int
    in_sphere: bool = False


def seeded_keys(points: Array, order: SeededOrder) -> NDArray[np.int64]:
    """Return a key for every point.

    The keys do not depend on the order of the input, on the other clouds in the batch, or on
    whether the coordinates are given in float32 or float64. Copies of a point get independent keys;
    the order among them follows the input.

    Args:
        points: ``(B, N, C)`` float32 or float64; finite, if hashed in the unit sphere.
        order: the seed, and what to hash.

    Returns:
        ``(B, N)`` int64.
    """
    return _keys(points, order, distinct=True)


def point_hashes(points: Array, order: SeededOrder) -> NDArray[np.int64]:
    """Return keys ``(B, N)`` as ``seeded_keys``, but one key for all copies of a point."""
    return _keys(points, order, distinct=False)


def _keys(points: Array, order: SeededOrder, *, distinct: bool) -> NDArray[np.int64]:
    clouds, number, channels = points.shape
    flat = np.ascontiguousarray(points).reshape(-1)
    keys: NDArray[np.int64] = kernel_keys.keys_of(
        flat, clouds, channels, seed_word(order.seed), order.in_sphere, distinct
    )
    return keys.reshape(clouds, number)


def seed_word(seed: int) -> np.uint64:
    """Return the word from which the hash of every point starts."""
    return np.uint64((seed * STEP + 1) % WORD)


def unit_spheres(points: Array) -> NDArray[np.float64]:
    """Return the centre and the radius ``(B, C + 1)`` of clouds ``(B, N, C)``, finite.

    They do not depend on the order of the points. The radius is 1 where all points coincide.
    """
    clouds, _, channels = points.shape
    flat = np.ascontiguousarray(points).reshape(-1)
    spheres: NDArray[np.float64] = kernel_keys.spheres_of(flat, clouds, channels)
    return spheres.reshape(clouds, channels + 1)


def are_finite(values: Array) -> bool:
    """Return whether no value of a float32 or float64 array is NaN or infinite.

    It takes a twentieth of the time of ``isfinite``, which writes an answer for each.
    """
    if not values.size:
        return True
    flat = np.ascontiguousarray(values).reshape(-1)
    finite: bool = kernel_keys.are_finite(flat)
    return finite
