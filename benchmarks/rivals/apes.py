"""APES, a published sampler to compare with, written from the formulas of its paper."""

from collections.abc import Sequence
from typing import Literal

from torch import Tensor, nn

from mops_lightning.errors import UserError, check_at_least
from mops_lightning.losses.subset import simplification_losses
from mops_lightning.nets.layers import PointMLP
from mops_lightning.ops.nearest import k_nearest
from mops_lightning.ops.points import gather_points
from mops_lightning.types import SampleOutput

from .selector import Selector


class APES(Selector):
    """APES: the input points with the most conspicuous attention, which lie on edges.

    Wu et al., "Attention-based Point Cloud Edge Sampling", CVPR 2023. From features of the points,
    attention softmax(Q·Kᵀ/√C) is computed: ``local``, from every point over its k nearest points,
    whose weights' standard deviation is the point's score; or ``global``, over the cloud, where the
    score is the sum of a point's column. The points with the m largest scores are selected.

    Differences from the publication: there, the layer is inside a classifier, whose next layer gets
    the rows of attention of the selected points times the values; here, it selects input points for
    a task net. In training, a selected point has the gradient of its row times the coordinates. The
    simplification loss is an addition, with weight 0 as published.

    Args:
        m: number of points to select.
        variant: ``local`` or ``global``.
        alpha: weight of the simplification loss.
        k: number of neighbours of the local variant.
        channels: channels of queries and keys.
        feature_channels: sizes of the pointwise layers.
        candidates: as for ``Selector``.

    Raises:
        UserError: an argument is out of range.
    """

    def __init__(
        self,
        m: int,
        variant: Literal["local", "global"] = "local",
        alpha: float = 0.0,
        k: int = 32,
        channels: int = 64,
        feature_channels: Sequence[int] = (64, 64, 64, 128, 128),
        candidates: int | None = 256,
    ) -> None:
        super().__init__(m, candidates)
        if variant not in ("local", "global"):
            raise UserError(f"variant must be local or global, got {variant!r}.")
        check_at_least(0, alpha=alpha)
        check_at_least(2, k=k)
        check_at_least(1, channels=channels)
        self.variant = variant
        self.alpha = alpha
        self.k = k
        self.features = PointMLP([3, *feature_channels])
        self.queries = nn.Linear(feature_channels[-1], channels, bias=False)
        self.keys = nn.Linear(feature_channels[-1], channels, bias=False)

    def attention(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return the scores ``(B, N)`` of ``(B, N, 3)`` points, and means ``(B, N, 3)`` by rows."""
        features = self.features(points).to(points)
        queries = self.queries(features) * self.queries.out_features**-0.5
        logits = queries @ self.keys(features).mT
        if self.variant == "global":
            weights = logits.softmax(2)
            return weights.sum(1), weights @ points
        # The published keys are those of f_j − f_i: the part of f_i is cancelled by the softmax.
        near = k_nearest(points.detach(), points.detach(), min(self.k, points.shape[1]))[1]
        weights = logits.gather(2, near).softmax(2)
        return weights.std(2), (weights[..., None] * gather_points(points, near)).sum(2)

    def select_rows(self, points: Tensor, m: int) -> SampleOutput:
        """Select points; in training, add means that have the gradient."""
        scores, means = self.attention(points)
        rows = scores.topk(m).indices
        chosen = gather_points(points, rows)
        if not self.training:
            return SampleOutput(chosen, rows, {})
        mean = gather_points(means, rows)
        return SampleOutput(chosen, rows, {}, soft_projected=chosen + mean - mean.detach())

    def losses(
        self, points: Tensor, output: SampleOutput, sizes: Sequence[int]
    ) -> dict[int, dict[str, Tensor]]:
        """Return α times the simplification loss at every size; nothing where α is 0."""
        if not self.alpha:
            return {}
        assert output.soft_projected is not None
        losses = simplification_losses(points, output.soft_projected, sizes)
        return {m: {"simplification": self.alpha * loss} for m, loss in losses.items()}
