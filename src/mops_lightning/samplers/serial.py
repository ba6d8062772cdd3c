"""Serial sampling: every k-th point along a Morton curve, in linear time but for a sort."""

import numpy as np
import torch
from torch import Tensor

from mops_lightning.ops import kernel_order
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.ordering import seeded_keys
from mops_lightning.types import SampleOutput

BITS = 21
"""Bits of a coordinate: three of them fill an int64 but for its sign."""


def _spread_bits(number: int) -> int:
    """Return a number of 11 bits with two zeros between its bits."""
    spread = 0
    for bit in range(11):
        spread += (number >> bit & 1) << 3 * bit
    return spread


SPREAD = np.array([_spread_bits(number) for number in range(2**11)])
"""Numbers of 11 bits with two zeros after every bit."""


class SerialSampler(Sampler):
    """Sort the points along a Morton curve (z-order) and return every k-th of them.

    Wu et al., "Point Transformer V3", CVPR 2024, serialise clouds in this way. The curve runs
    through the cells of a cube around the cloud, 2²¹ per side. Flexible, but not nested.

    Args:
        m: largest number of points to return.

    Examples:
        >>> import torch
        >>> from mops_lightning import SerialSampler
        >>> line = torch.tensor([[[0.0, 0, 0], [3, 0, 0], [1, 0, 0], [2, 0, 0]]])
        >>> SerialSampler(m=2)(line).indices  # (B, N, 3) to (B, m)
        tensor([[2, 1]])
    """

    flexible = True
    any_unit = True
    spreads = False

    def sample(self, points: Tensor, m: int) -> SampleOutput:
        """Return m of the points ``(B, N, 3)`` with their indices, along the curve."""
        along = along_curve(points)
        indices = _every_kth(along, m)
        return SampleOutput(gather_points(points, indices), indices, {})

    def choose_rows(self, points: Tensor, m: int, weight: Tensor | None = None) -> Tensor:
        """Choose as ``sample`` does, in any unit; without weights."""
        along = along_curve(points, in_sphere=True)
        return _every_kth(along, m)


def _every_kth(along: Tensor, m: int) -> Tensor:
    """Return m rows ``(B, m)`` at equal distances among rows ``(B, N)``."""
    # The middles of m equal parts of the curve.
    halves = torch.arange(m, device=along.device) * 2 + 1
    places = halves * along.shape[1] // (2 * m)
    return along[:, places]


def along_curve(points: Tensor, in_sphere: bool = False) -> Tensor:
    """Return the rows ``(B, N)`` in the order of the curve; the seeded order breaks ties.

    ``in_sphere``: take the order of the clouds in the unit sphere; see ``ops.keys.SeededOrder``.
    """
    codes = morton_codes(points).numpy()
    order = np.argsort(codes, axis=1)
    ordered = np.take_along_axis(codes, order, 1)
    is_copy = ordered[:, 1:] == ordered[:, :-1]
    if is_copy.any():
        keys = seeded_keys(points, 0, in_sphere).cpu().numpy()
        order = np.lexsort((keys, codes), axis=1)
    return torch.from_numpy(order).to(points.device)


def morton_codes(points: Tensor) -> Tensor:
    """Return the place on the curve ``(B, N)`` int64 of points ``(B, N, 3)``, on the CPU."""
    coordinates = points.detach().cpu()
    if coordinates.dtype not in (torch.float32, torch.float64):
        coordinates = coordinates.float()
    flat = coordinates.contiguous().numpy().reshape(-1)
    codes = kernel_order.morton_codes(flat, len(points), SPREAD)
    return torch.from_numpy(codes).view(points.shape[:2])
