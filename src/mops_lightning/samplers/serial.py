"""Serial sampling: every k-th point along a Morton curve, in linear time but for a sort."""

import torch
from torch import Tensor

from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.ordering import seeded_order
from mops_lightning.types import SampleOutput

BITS = 21
"""Bits of a coordinate: three of them fill an int64 but for its sign."""

SPREADS = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
"""Shifts and masks that put two zeros after every bit of a coordinate."""


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
    spreads = False

    def sample(self, points: Tensor, m: int) -> SampleOutput:
        """Return m of the points ``(B, N, 3)`` with their indices, along the curve."""
        order = seeded_order(points, seed=0)  # ties do not depend on the input order
        codes = morton_codes(gather_points(points.detach(), order))
        along = order.gather(1, codes.argsort(dim=1, stable=True))
        n = points.shape[1]
        indices = along[:, (torch.arange(m, device=points.device) * 2 + 1) * n // (2 * m)]
        return SampleOutput(gather_points(points, indices), indices, {})


def morton_codes(points: Tensor) -> Tensor:
    """Return the place on the curve ``(B, N)`` int64 of points ``(B, N, 3)``."""
    offsets = points.double() - points.double().amin(1, keepdim=True)
    side = offsets.amax((1, 2), keepdim=True).clamp_min(torch.finfo(torch.float64).tiny)
    cells = (offsets / side * (2**BITS - 1)).long()
    for shift, mask in SPREADS:
        cells = (cells | cells << shift) & mask
    x, y, z = cells.unbind(2)
    return x << 2 | y << 1 | z
