"""Metrics of the sampled set itself, for every task: one number per cloud, averaged over clouds.

``measure`` takes the points ``(B, N, 3)``, the sampler's output and sizes; for size m the first m
samples count. It returns ``(B,)`` numbers by size, or None if the metric is undefined.
"""

from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor

from mops_lightning.channels import coordinates
from mops_lightning.metrics.base import MeanOverClouds
from mops_lightning.ops.nearest import nearest
from mops_lightning.ops.readout import match, unique_count
from mops_lightning.types import SampleOutput

NONZERO_THRESHOLD = 0.01
"""Entries of S below this count as zero (paper, table of the non-zero elements)."""

BySize = dict[int, Tensor]


class SetMetric(MeanOverClouds):
    """Mean over clouds of a number that ``measure`` gives for each.

    Attributes:
        group: the part of the log key before the name: a readout, or ``matrix``.
    """

    group: ClassVar[str]
    higher_is_better: bool | None = None
    summary_order = None

    @staticmethod
    def measure(points: Tensor, output: SampleOutput, sizes: Sequence[int]) -> BySize | None:
        """Return ``(B,)`` numbers by size; None where the metric is undefined."""
        raise NotImplementedError


class SubsetDistance(SetMetric):
    """(1/m) Σ_j min_i ‖q_j − p_i‖²: the paper's L_subset without its weight.

    In squared units of the coordinates.
    """

    name = "subset_distance"
    group = "generated"
    higher_is_better = False

    @staticmethod
    def measure(points: Tensor, output: SampleOutput, sizes: Sequence[int]) -> BySize:
        """Return the mean squared distance to the nearest input points."""
        distances, _ = nearest(coordinates(output.points), coordinates(points))
        return {m: distances[:, :m].mean(1) for m in sizes}


class UniquePoints(SetMetric):
    """Number of distinct input points that are matched, at most m."""

    name = "unique_points"
    group = "matched"
    higher_is_better = True

    @staticmethod
    def measure(points: Tensor, output: SampleOutput, sizes: Sequence[int]) -> BySize:
        """Return the numbers of distinct matches."""
        indices = output.indices
        if indices is None:
            indices = match(output.points, points)
        return {m: unique_count(indices[:, :m]).to(points.dtype) for m in sizes}


class NonzeroPercent(SetMetric):
    """Entries of S that reach 0.01, in percent; undefined without S."""

    name = "nonzero_percent"
    label = "non-zero entries of S"
    group = "matrix"
    unit = "%"
    higher_is_better = False

    @staticmethod
    def measure(points: Tensor, output: SampleOutput, sizes: Sequence[int]) -> BySize | None:
        """Return the percentages; None without S."""
        if output.matrix is None:
            return None
        counts = output.matrix.nonzero_counts(NONZERO_THRESHOLD)
        n_points = points.shape[1]
        return {m: 100 * counts[:, :m].mean(1) / n_points for m in sizes}


class OrthogonalityError(SetMetric):
    """‖SᵀS − I‖_F, which the paper's Eq. (3) bounds; undefined without S."""

    name = "orthogonality_error"
    group = "matrix"
    higher_is_better = False

    @staticmethod
    def measure(points: Tensor, output: SampleOutput, sizes: Sequence[int]) -> BySize | None:
        """Return the Frobenius norms; None without S."""
        if output.matrix is None:
            return None
        gram = output.matrix.gram()
        identity = torch.eye(gram.shape[-1]).to(gram)
        error = gram - identity
        return {m: torch.linalg.matrix_norm(error[:, :m, :m]) for m in sizes}


SET_METRICS: dict[str, type[SetMetric]] = {
    f"{metric.group}/{metric.name}": metric
    for metric in (SubsetDistance, UniquePoints, NonzeroPercent, OrthogonalityError)
}
"""By log key, without stage and size."""
