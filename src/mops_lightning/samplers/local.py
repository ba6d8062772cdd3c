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

FIRST_LEVEL = 8
"""Number of columns of the first level of ``NestedLocalAnchors``."""


class Thinned(NamedTuple):
    """The candidates of clouds.

    Attributes:
        rows: ``(B, K)`` int64, the candidates' rows in the cloud; None: all points, in their order.
        order: ``(B, F)`` int64, the places of farthest points among the candidates, as chosen. The
            first m are the anchors.
        unit: ``(B,)``, the squared unit of widths.
    """

    rows: Tensor | None
    order: Tensor
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
        anchor_places = thinned.order[:, :m]
        anchors = gather_points(candidates, anchor_places)
        content = self._content(gather_points(keys, anchor_places), m)
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
            near = self._near(anchors, candidates, thinned.order, k)
            entries = Entries(candidates, anchor_places, near)
            weights = column_weights(content, keys, entries, sharpness, tau)
        rows = near
        if thinned.rows is not None:
            rows = thinned.rows.gather(1, near.flatten(1)).view_as(near)
        return LocalMatrix(weights, rows, points.shape[1])

    def thin(self, places: Tensor, m: int) -> Thinned:
        """Choose the candidates of clouds ``(B, N, 3)``, and m anchors among them."""
        clouds, n, _ = places.shape
        wanted = self._wanted(n)
        number = self._ordered(n, m) if wanted is None else wanted
        farthest = rows_from_mean(places, number)
        first_places = gather_points(places, farthest[:, :SPACING_POINTS])
        unit = squared_spacing(first_places)
        if wanted is None:
            return Thinned(None, farthest, unit)
        in_order = torch.arange(wanted, device=places.device)
        return Thinned(farthest[:, :wanted], in_order.expand(clouds, wanted), unit)

    def _ordered(self, n: int, m: int) -> int:
        """Return how many farthest points of n are needed where all points are candidates."""
        return m

    def _near(self, anchors: Tensor, candidates: Tensor, order: Tensor, k: int) -> Tensor:
        """Return the places ``(B, m, k)`` of the candidates of every column.

        Args:
            anchors: ``(B, m, 3)``.
            candidates: ``(B, K, 3)``.
            order: see ``Thinned``.
            k: number of entries.
        """
        return nearest_rows(anchors, candidates, k)

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


class NestedLocalAnchors(LocalAnchors):
    """Local columns of a net whose first m columns are the sample of size m, for every m.

    The k nearest of c·m_max candidates are too near to each other for a sample of few points.
    Column j therefore chooses among the first c·L candidates, where L is the smallest of
    ``FIRST_LEVEL``, twice, four times ... as many columns that include it: these are the candidates
    that a net for L points would have. They do not depend on m, so that smaller samples are
    prefixes of larger ones.
    """

    def _ordered(self, n: int, m: int) -> int:
        if self.candidates is None or self.neighbours is None:
            return m
        numbers = [max(self.candidates * stop, self.neighbours) for _, stop in levels(m)]
        return max([m, *(number for number in numbers if number < n)])

    def _near(self, anchors: Tensor, candidates: Tensor, order: Tensor, k: int) -> Tensor:
        if self.candidates is None:
            return super()._near(anchors, candidates, order, k)
        near = []
        for start, stop in levels(anchors.shape[1]):
            number = max(self.candidates * stop, k)
            columns = anchors[:, start:stop]
            if number >= candidates.shape[1]:
                near.append(nearest_rows(columns, candidates, k))
                continue
            first = order[:, :number]
            rows = nearest_rows(columns, gather_points(candidates, first), k)
            places = first.gather(1, rows.flatten(1))
            near.append(places.view_as(rows))
        return torch.cat(near, 1)


def levels(m: int) -> list[tuple[int, int]]:
    """Return where the levels of m columns start and stop; the last stop may exceed m.

    Examples:
        >>> levels(20)
        [(0, 8), (8, 16), (16, 32)]
    """
    found = [(0, FIRST_LEVEL)]
    while found[-1][1] < m:
        stop = found[-1][1]
        found.append((stop, 2 * stop))
    return found
