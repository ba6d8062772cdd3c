"""MOPS-Net with anchors: the columns of S start as a soft choice of farthest points.

Column j of S belongs to the j-th farthest point q_j of the cloud. Its logits are

    ⟨w_j + A·h(q_j)/√C, h_i⟩ − |p_i − q_j|² / s_j²,

with the keys h_i of the points. w and A start at zero, so that an untrained sampler returns
weighted means around farthest points, and training moves them. The distances are products, too:
−|p_i − q_j|² = 2⟨p_i, q_j⟩ − |p_i|² − |q_j|², whose last term is constant in a column, where the
softmax cancels it. So S remains an attention, with four more channels and queries of every cloud.
"""

import math

import torch
from torch import Tensor, nn

from mops_lightning.ops.points import distance_dtype, gather_points
from mops_lightning.ops.sampling_matrix import SamplingMatrix
from mops_lightning.ops.traced_farthest import farthest_from_mean
from mops_lightning.samplers.fps import FARTHEST, farthest_rows

SPACING_POINTS = 64
"""The unit of widths is the spacing of this number of farthest points of the cloud."""

SMALLEST = 1e-3
"""Lower bound of the width, for clouds with coincident points."""


class FPSAnchors(nn.Module):
    """Queries around the farthest points of a cloud.

    The first point is the one farthest from the mean; a random order of the points, which depends
    on the cloud only, breaks ties (see ``ordering``). So the anchors turn and move with the cloud,
    and the first m of them are the anchors for size m.

    Args:
        m: largest number of points.
        channels: C, of the keys.
        width: s_j before training, as a share of the spacing of m farthest points.
    """

    def __init__(self, m: int, channels: int, width: float) -> None:
        super().__init__()
        # Another name than in the plain net, so that a warm start does not copy its weight.
        self.slots = nn.Parameter(torch.zeros(m, channels))
        self.relation = nn.Parameter(torch.zeros(channels, channels))
        # On a surface the spacing of k points decreases as √(1/k).
        first = width * math.sqrt(SPACING_POINTS / m)
        log_width = torch.full((m,), math.log(first))
        self.log_width = nn.Parameter(log_width)

    @property
    def weight(self) -> Tensor:
        """The vectors w ``(m, C)``."""
        return self.slots

    def least_points(self, m: int) -> int:
        """Return how many points a cloud must have in an exported program for m columns."""
        return max(m, SPACING_POINTS)

    def forward(self, points: Tensor, keys: Tensor, m: int, tau: float) -> SamplingMatrix:
        """Return the first m columns of the sampling matrices.

        Args:
            points: ``(B, N, 3)``.
            keys: ``(B, N, C)``, the output of the hidden layers of ρ.
            m: number of columns.
            tau: temperature.

        Returns:
            Matrices with queries ``(B, m, C + 4)``, in float32 at least.
        """
        dtype = distance_dtype(points)
        places = points.to(dtype)
        keys = keys.to(dtype)
        # Distances are more precise around the mean.
        centred = places - places.mean(1, keepdim=True)
        rows = rows_from_mean(places, m)
        first_places = gather_points(centred, rows[:, :SPACING_POINTS])
        unit = squared_spacing(first_places)
        rows = rows[:, :m]
        anchors = gather_points(centred, rows)
        log_width = self.log_width[:m].to(dtype)
        width = unit[:, None] * log_width.mul(2).exp()
        sharpness = width.clamp_min(SMALLEST**2).reciprocal()[..., None]
        keys_of_anchors = gather_points(keys, rows)
        related = keys_of_anchors @ self.relation.to(dtype).mT
        slots = self.slots[:m].to(dtype)
        content = slots + related / math.sqrt(keys.shape[2])
        queries = torch.cat([content, 2 * sharpness * anchors, -sharpness], 2)
        squares = centred.square().sum(2, keepdim=True)
        keys_with_places = torch.cat([keys, centred, squares], 2)
        return SamplingMatrix(queries, keys_with_places, tau)


def rows_from_mean(places: Tensor, number: int) -> Tensor:
    """Return the rows of the farthest points that determine anchors and the unit of widths.

    Args:
        places: ``(B, N, 3)``.
        number: number of farthest points that are needed, beside those for the unit.

    Returns:
        ``(B, K)`` int64 in the order of choice, with K = max(``number``, ``SPACING_POINTS``), but
        at most N. Exported programs need N ≥ K.
    """
    wanted = max(number, SPACING_POINTS)
    if torch.compiler.is_exporting():
        return farthest_from_mean(places, wanted)
    wanted = min(wanted, places.shape[1])
    return farthest_rows(places, wanted, start=FARTHEST)


def squared_spacing(farthest: Tensor) -> Tensor:
    """Return the squared spacing ``(B,)`` of ``SPACING_POINTS`` farthest points.

    It is the squared distance of the last point to the nearest of those before it. Where a cloud
    has fewer points, it is scaled as on a surface.

    Args:
        farthest: ``(B, K, 3)`` in the order of choice.
    """
    count = farthest.shape[1]
    if count < 2:
        return farthest.new_ones(len(farthest))
    to_last = farthest[:, :-1] - farthest[:, -1:]
    spacing = to_last.square().sum(2).amin(1)
    return spacing * (count / SPACING_POINTS)
