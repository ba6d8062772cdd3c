"""APES, a published sampler to compare with."""

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from mops_lightning.errors import UserError, check_at_least
from mops_lightning.losses.subset import simplification_losses
from mops_lightning.ops.nearest import nearest_features
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.base import Sampler
from mops_lightning.types import SampleOutput

from .edge_net import EdgeEmbedding, NeighbourAttention, check_channels
from .selector import candidate_rows, straight_through

STAGES = 2


class EdgeSampling(nn.Module):
    """One sampling layer of APES: scores from attention, and the attention itself.

    Args:
        channels: channels of the features, queries and keys.
        variant: ``local`` or ``global``; see ``APES``.
        k: number of neighbours of the local variant.
    """

    def __init__(self, channels: int, variant: str, k: int) -> None:
        super().__init__()
        self.variant = variant
        self.k = k
        self.queries = nn.Linear(channels, channels, bias=False)
        self.keys = nn.Linear(channels, channels, bias=False)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return scores ``(B, N)``, attention ``(B, N, K)`` and its rows ``(B, N, K)``."""
        queries = self.queries(features) * self.queries.out_features**-0.5
        logits = queries @ self.keys(features).mT
        if self.variant == "global":
            weights = logits.softmax(2)
            rows = torch.arange(logits.shape[2], device=logits.device).expand_as(logits)
            return weights.sum(1), weights, rows
        # The published keys are those of f_j − f_i: the part of f_i is cancelled by the softmax.
        rows = nearest_features(features, self.k)
        weights = logits.gather(2, rows).softmax(2)
        return weights.std(2, unbiased=False), weights, rows


class APES(Sampler):
    """APES: the input points with the most conspicuous attention, which lie on edges.

    Wu et al., "Attention-based Point Cloud Edge Sampling", CVPR 2023. Features come from two edge
    convolutions and attention to neighbours. In each of two stages, attention softmax(Q·Kᵀ/√C) is
    computed: ``local``, from every point over its k nearest points in the space of the features,
    whose weights' standard deviation is the point's score; or ``global``, over the cloud, where the
    score is the sum of a point's column. The points with the largest scores are kept, with the
    attention times the values as their new features; in the local variant, these are values of the
    differences from the point. The first stage keeps twice as many points as the second, as in the
    published classifier.

    Differences from the publication: there, the stages are inside a classifier, which gets the
    features; here, they select input points for a task net. In training, a selected point has the
    gradient of its attention times the coordinates. The simplification loss is an addition, with
    weight 0 as published.

    Args:
        m: number of points to select.
        variant: ``local`` or ``global``.
        alpha: weight of the simplification loss.
        farthest: choose among 4m farthest points, whose features are those in the whole cloud, as
            by an option of the code of SAMBLE, which has APES, too; otherwise among all points.
        k: number of neighbours.
        channels: channels of the features.
        heads: heads of the attention to neighbours.

    Raises:
        UserError: an argument is out of range.
    """

    def __init__(
        self,
        m: int,
        variant: Literal["local", "global"] = "local",
        alpha: float = 0.0,
        farthest: bool = True,
        k: int = 32,
        channels: int = 128,
        heads: int = 4,
    ) -> None:
        super().__init__(m)
        if variant not in ("local", "global"):
            raise UserError(f"variant must be local or global, got {variant!r}.")
        check_at_least(0, alpha=alpha)
        check_at_least(2, k=k)
        check_channels(channels, heads)
        self.alpha = alpha
        self.variant = variant
        self.farthest = farthest
        self.embedding = EdgeEmbedding((128, 128), channels, k)
        self.attention = nn.ModuleList(
            NeighbourAttention(channels, heads, 4, k) for _ in range(STAGES)
        )
        self.sampling = nn.ModuleList(EdgeSampling(channels, variant, k) for _ in range(STAGES))
        self.values = nn.Linear(channels, channels, bias=False)

    def sample(self, points: Tensor, m: int) -> SampleOutput:
        """Select points; see ``Sampler.forward``."""
        kept = min(2 * m, points.shape[1])
        candidates = candidate_rows(points, kept, self.farthest)
        features = self.attention[0](self.embedding(points))
        features = gather_points(features, candidates)
        remaining = gather_points(points, candidates)
        scores, weights, near = self.sampling[0](features)
        first = scores.topk(kept).indices
        means = _attended(remaining, weights, near, first)
        features = self.attended_values(features, weights, near, first)

        features = self.attention[1](features)
        soft = straight_through(gather_points(remaining, first), means)
        scores, weights, near = self.sampling[1](features)
        second = scores.topk(m).indices
        means = _attended(soft, weights, near, second)

        rows = candidates.gather(1, first.gather(1, second))
        chosen = gather_points(points, rows)
        if not self.training:
            return SampleOutput(chosen, rows, {})
        return SampleOutput(chosen, rows, {}, soft_projected=straight_through(chosen, means))

    def attended_values(
        self, features: Tensor, weights: Tensor, near: Tensor, rows: Tensor
    ) -> Tensor:
        """Return the features ``(B, M, C)`` of the points that the first stage keeps.

        They are the attention of a point times the values: of the neighbours' differences from it
        in the local variant, of all points in the global one.

        Args:
            features: ``(B, N, C)``.
            weights: ``(B, N, K)`` attention of every point.
            near: ``(B, N, K)`` the rows that it is for.
            rows: ``(B, M)`` the points.
        """
        values = self.values(features)
        attended = _attended(values, weights, near, rows)
        if self.variant == "global":
            return attended
        # The weights of a point have sum 1, so that its own values are subtracted once.
        return attended - gather_points(values, rows)

    def losses(
        self, points: Tensor, output: SampleOutput, sizes: Sequence[int]
    ) -> dict[int, dict[str, Tensor]]:
        """Return α times the simplification loss at every size; nothing where α is 0."""
        if not self.alpha:
            return {}
        assert output.soft_projected is not None
        losses = simplification_losses(points, output.soft_projected, sizes)
        return {m: {"simplification": self.alpha * loss} for m, loss in losses.items()}


def _attended(values: Tensor, weights: Tensor, near: Tensor, rows: Tensor) -> Tensor:
    """Return the attention of the selected points times the values of what it is for.

    Args:
        values: ``(B, N, C)``.
        weights: ``(B, N, K)`` attention of every point.
        near: ``(B, N, K)`` the rows that it is for.
        rows: ``(B, M)`` the selected points.

    Returns:
        ``(B, M, C)``.
    """
    places = rows[..., None].expand(-1, -1, near.shape[2])
    of_selected = weights.gather(1, places)
    return (of_selected[..., None] * gather_points(values, near.gather(1, places))).sum(2)
