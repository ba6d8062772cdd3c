"""Farthest point sampling on a CPU by fewer operations than looking at all points at each step.

Of small clouds all distances are taken at once, and a step has no more to do than to compare.

In large clouds most points are far from the new one. Neighbouring points form groups. A group that
is farther from the new point than all its points are from the chosen ones keeps its distances, so
that a step looks at a few groups only. (Han et al., "QuickFPS", IEEE TCAD 2023, and others before
them do so in trees.)
"""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

SIZE = 128
"""Points in a group: fewer make the groups many, more make each step look at more points."""

SAFE = 1 - 1e-6
"""Bounds are lowered by it, for sums of squares are rounded in another way than distances are."""


def squared_lengths_(planes: Tensor) -> Tensor:
    """Sum the squares of planes ``(C, ...)``, in place of the first one.

    All ways to farthest points do it here: some processors multiply and add in one rounding, others
    in two, and all ways must come to the same bits.
    """
    total, *others = planes.unbind(0)
    total.mul_(total)
    for other in others:
        total.addcmul_(other, other)
    return total


def take_farthest_by_table(points: Tensor, distances: Tensor, steps: int) -> Tensor:
    """Do what ``take_farthest_by_groups`` does, from a table of all distances.

    Args:
        points: ``(N, C)`` on the CPU, finite; N² distances are held.
        distances: as there.
        steps: as there.

    Returns:
        As there.
    """
    planes = points.to(distances.dtype).mT.contiguous()
    table = squared_lengths_(planes[:, :, None] - planes[:, None])
    rows, far = table.numpy(), distances.numpy().copy()
    taken = np.empty(steps, np.int64)
    for step in range(steps):
        row = far.argmax()
        taken[step] = row
        far[row] = -1
        np.minimum(far, rows[row], out=far)
    return torch.from_numpy(taken)


def take_farthest_by_groups(points: Tensor, distances: Tensor, steps: int) -> Tensor:
    """Take the point with the largest distance, lower the distances to it, and so on.

    Args:
        points: ``(N, C)`` on the CPU, finite, C up to 4.
        distances: ``(N,)`` squared distances to start from, of at least float32; what is taken
            stands at -1.
        steps: how many points to take, at most as many as are not taken.

    Returns:
        ``(steps,)`` int64, the lowest row of equally far ones; bit for bit what looking at all
        points gives.
    """
    n = len(points)
    array = points.to(distances.dtype).numpy()
    # Rows stand in order within a group, so that its first maximum is that of the lowest row; the
    # last group is filled up with copies that count as taken.
    rows = np.full(math.ceil(n / SIZE) * SIZE, n)
    rows[:n] = np.argsort(_places_on_curve(array), kind="stable")
    rows = np.sort(rows.reshape(-1, SIZE), axis=1)
    filled = np.minimum(rows, n - 1)
    filled = np.where(rows < n, filled, filled[:, :1])
    planes = np.ascontiguousarray(array[filled].transpose(2, 0, 1))
    far = np.where(rows < n, distances.numpy()[filled], -1).astype(array.dtype)
    low, high = planes.min(2), planes.max(2)
    places = far.argmax(1)
    every = np.arange(len(rows))
    peaks, peak_rows = far[every, places], rows[every, places]
    taken = np.empty(steps, np.int64)
    for step in range(steps):
        equal = np.flatnonzero(peaks == peaks.max())
        group = equal[peak_rows[equal].argmin()]
        place = places[group]
        taken[step] = rows[group, place]
        far[group, place] = -1
        new = planes[:, group, place]
        bound = _distances_to_boxes(low, high, new) * SAFE
        near = bound < peaks
        near[group] = True
        touched = np.flatnonzero(near)
        lowered = _lowered(planes.take(touched, 1), new, far.take(touched, 0))
        far[touched] = lowered
        inside = lowered.argmax(1)
        places[touched] = inside
        peaks[touched] = lowered[every[: len(touched)], inside]
        peak_rows[touched] = rows[touched, inside]
    return torch.from_numpy(taken)


def _lowered(
    planes: NDArray[np.floating], new: NDArray[np.floating], far: NDArray[np.floating]
) -> NDArray[np.floating]:
    """Return the lower of old distances and those to a new point."""
    differences = torch.from_numpy(planes).sub_(torch.from_numpy(new)[:, None, None])
    return torch.minimum(torch.from_numpy(far), squared_lengths_(differences)).numpy()


def _distances_to_boxes(
    low: NDArray[np.floating], high: NDArray[np.floating], point: NDArray[np.floating]
) -> NDArray[np.floating]:
    """Return the squared distances from a point ``(C,)`` to boxes with corners ``(C, G)``."""
    with np.errstate(over="ignore"):
        away = np.maximum(low - point[:, None], point[:, None] - high)
        np.maximum(away, 0, out=away)
        away *= away
        return away.sum(0)


def _places_on_curve(points: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return where points ``(N, C)`` lie on a Z-order curve: near on it is near in space."""
    bits = 30 // points.shape[1]
    low = points.min(0).astype(np.float64)
    with np.errstate(all="ignore"):
        scale = (2**bits - 1) / (points.max(0) - low).max()
        if not 0 < scale < np.inf:  # all coincide, or too far apart to be told
            return np.zeros(len(points), np.int64)
        cells = ((points - low) * scale).astype(np.int64)
    code = np.zeros(len(points), np.int64)
    for bit in range(bits):
        for axis in range(points.shape[1]):
            code |= (cells[:, axis] >> bit & 1) << (points.shape[1] * bit + axis)
    return code
