"""Local columns of S: column j chooses among the candidates that are nearest to its anchor.

Candidates are the first c·m farthest points of the cloud (c·m_max for a net of many sizes, whose
smaller samples are therefore prefixes), and the first m of them are the anchors: one run of
farthest points gives both. Features and keys are computed for candidates only, and the global
feature is the maximum over them. Memory and time grow with m·c and m·k, not with N·m.

Column j has the logits of an anchored column (see ``anchors``),

    ⟨w_j + A·h(q_j)/√C, h_i⟩ − |p_i − q_j|² / s_j²,

for its k nearest candidates p_i, and −∞ elsewhere.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from mops_lightning.ops.local_attention import Entries, column_weights, nearest_rows
from mops_lightning.ops.local_matrix import LocalMatrix
from mops_lightning.ops.points import distance_dtype, gather_points
from mops_lightning.samplers.anchors import (
    SMALLEST,
    SPACING_POINTS,
    FPSAnchors,
    rows_from_mean,
    squared_spacing,
)


class Thinned(NamedTuple):
    """The candidates of clouds.

    Attributes:
        rows: ``(B, K)`` int64, the candidates' rows in the cloud; None: all points, in their order.
        anchors: ``(B, m)`` int64, the places of the anchors among the candidates.
        unit: ``(B,)``, the squared unit of widths.
    """

    rows: Tensor | None
    anchors: Tensor
    unit: Tensor

    def of(self, values: Tensor) -> Tensor:
        """Return the values ``(B, K, V)`` of the candidates, from those of all points."""
        if self.rows is None:
            return values
        return gather_points(values, self.rows)


Keys = Callable[[Thinned], Tensor]
"""From the candidates of clouds to their keys ``(B, K, C)``."""


class LocalAnchors(FPSAnchors):
    """Columns around the farthest points of a cloud with few entries each.

    Args:
        m: largest number of points.
        channels: C, of the keys.
        width: see ``FPSAnchors``.
        candidates: c, candidates per point of the largest sample; None: all points of the cloud.
        neighbours: k, entries of a column; None: all candidates.
    """

    def __init__(
        self,
        m: int,
        channels: int,
        width: float,
        candidates: int | None,
        neighbours: int | None,
    ) -> None:
        super().__init__(m, channels, width)
        self.candidates = candidates
        self.neighbours = neighbours

    def least_points(self, m: int) -> int:
        """Return how many points a cloud must have in an exported program for m columns."""
        if self.candidates is None:
            return max(super().least_points(m), self.neighbours or 1)
        return super().least_points(self.candidates * len(self.slots))

    def local_matrix(self, points: Tensor, keys_of: Keys, m: int, tau: float) -> LocalMatrix:
        """Return the first m columns of the sampling matrices.

        Args:
            points: ``(B, N, 3)``.
            keys_of: computes the keys of candidates.
            m: number of columns.
            tau: temperature.

        Returns:
            Matrices in float32 at least.
        """
        places = points.to(distance_dtype(points))
        thinned = self.thin(places, m)
        candidates = thinned.of(places)
        keys = keys_of(thinned).to(places.dtype)
        anchors = gather_points(candidates, thinned.anchors)
        content = self._content(gather_points(keys, thinned.anchors), m)
        sharpness = self._sharpness(thinned.unit, m)
        if self.neighbours is None:
            apart = candidates[:, None] - anchors[:, :, None]
            squares = apart.square().sum(3)
            logits = content @ keys.mT - sharpness[..., None] * squares
            weights = (logits / tau).softmax(2)
            all_places = torch.arange(candidates.shape[1], device=points.device)
            near = all_places.expand_as(weights)
        else:
            k = min(self.neighbours, candidates.shape[1])
            near = nearest_rows(anchors, candidates, k)
            entries = Entries(candidates, thinned.anchors, near)
            weights = column_weights(content, keys, entries, sharpness, tau)
        rows = near
        if thinned.rows is not None:
            rows = thinned.rows.gather(1, near.flatten(1)).view_as(near)
        return LocalMatrix(weights, rows, points.shape[1])

    def thin(self, places: Tensor, m: int) -> Thinned:
        """Choose the candidates of clouds ``(B, N, 3)``, and m anchors among them."""
        clouds, n, _ = places.shape
        wanted = self._wanted(n)
        farthest = rows_from_mean(places, m if wanted is None else wanted)
        first_places = gather_points(places, farthest[:, :SPACING_POINTS])
        unit = squared_spacing(first_places)
        if wanted is not None:
            first_rows = torch.arange(m, device=places.device)
            anchors = first_rows.expand(clouds, m)
            return Thinned(farthest[:, :wanted], anchors, unit)
        return Thinned(None, farthest[:, :m], unit)

    def _wanted(self, n: int) -> int | None:
        """Return how many of n points are candidates; None: all, in the order of the cloud."""
        if self.candidates is None:
            return None
        wanted = self.candidates * len(self.slots)
        if torch.compiler.is_exporting():  # for any n from least_points
            return wanted
        if wanted < n:
            return wanted
        return None

    def _content(self, keys: Tensor, m: int) -> Tensor:
        """Return the vectors ``(B, m, C)`` that are compared with keys."""
        related = keys @ self.relation.to(keys.dtype).mT
        slots = self.slots[:m].to(keys.dtype)
        return slots + related / math.sqrt(keys.shape[2])

    def _sharpness(self, unit: Tensor, m: int) -> Tensor:
        """Return 1/s_j² ``(B, m)``."""
        log_width = self.log_width[:m].to(unit.dtype)
        width = unit[:, None] * log_width.mul(2).exp()
        return width.clamp_min(SMALLEST**2).reciprocal()
