"""SAMBLE, a published sampler to compare with."""

import torch
from torch import Tensor, nn

from mops_lightning.errors import UserError, check_at_least
from mops_lightning.ops.nearest import nearest_features
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.ordering import point_hashes
from mops_lightning.types import SampleOutput

from .edge_net import EdgeEmbedding, NeighbourAttention, check_channels, neighbour_mask
from .selector import candidate_rows, straight_through

STAGES = 2
SMALL = 1e-8
ROUNDING = 1e-4
"""A number this close below a whole one is whole: rounding depends on the order of the points."""


def sparse_scores(attention: Tensor, rows: Tensor) -> Tensor:
    """Return the score of every point from the attention that its neighbours pay to it.

    Only attention of a point to its k nearest points counts. The sum of a point's column is divided
    by the square of the number of points that it is a neighbour of.

    Args:
        attention: ``(B, N, N)``.
        rows: ``(B, N, k)`` the neighbours of every point.

    Returns:
        ``(B, N)``.
    """
    mask = neighbour_mask(rows).to(attention)
    return (attention * mask).sum(1) / mask.sum(1).clamp(min=1).square()


def allot(weights: Tensor, available: Tensor, m: int) -> Tensor:
    """Return how many points every bin gives.

    A bin gives points in proportion to its weight times its number of points, at most all of them;
    what is left over goes to the other bins in the same proportion. Fractions are rounded down; the
    missing points come one by one from the bin with the most points left (as published, all of them
    from one bin, which may have too few).

    Args:
        weights: ``(B, bins)``, at least 0.
        available: ``(B, bins)`` number of points of every bin.
        m: number of points of a sample, at most the number of points of a cloud.

    Returns:
        ``(B, bins)`` int64; a row's sum is m.
    """
    share = weights * available + 1e-10  # equal shares where no weight is positive
    given = torch.zeros_like(share)
    for _ in range(share.shape[1]):
        left = m - given.sum(1, keepdim=True)
        share = share / share.sum(1, keepdim=True).clamp(min=1e-30)
        given = torch.minimum(given + share * left, available)
        share = torch.where(given >= available, 0.0, share)
    counts = (given + ROUNDING).long()
    room = available.long() - counts
    for _ in range(share.shape[1]):
        missing = (m - counts.sum(1, keepdim=True)).clamp(0, 1)
        largest = room.argmax(1, keepdim=True)
        counts.scatter_add_(1, largest, missing)
        room.scatter_add_(1, largest, -missing)
    return counts


def chosen_rows(priorities: Tensor, bins: Tensor, counts: Tensor) -> Tensor:
    """Return the rows with the highest priorities of every bin.

    Args:
        priorities: ``(B, N)``.
        bins: ``(B, N)`` int64 the bin of every point.
        counts: ``(B, bins)`` how many points to take; the rows have equal sums M.

    Returns:
        ``(B, M)`` int64, by falling priority.
    """
    order = priorities.argsort(dim=1, descending=True, stable=True)
    of_order = bins.gather(1, order)
    places = nn.functional.one_hot(of_order, counts.shape[1]).cumsum(1)
    place = places.gather(2, of_order[..., None])[..., 0]
    taken = place <= counts.gather(1, of_order)
    return order[taken].view(len(order), -1)


class BinSampling(nn.Module):
    """One sampling layer of SAMBLE.

    Args:
        channels: channels of the features, queries and keys.
        bins: number of bins.
        k: number of neighbours.
        temperature: of the choice within a bin.
        momentum: of the boundaries between the bins.
    """

    boundaries: Tensor
    started: Tensor

    def __init__(
        self, channels: int, bins: int, k: int, temperature: float, momentum: float
    ) -> None:
        super().__init__()
        self.k = k
        self.temperature = temperature
        self.momentum = momentum
        self.queries = nn.Linear(channels, channels, bias=False)
        self.keys = nn.Linear(channels, channels, bias=False)
        self.tokens = nn.Parameter(torch.randn(bins, channels) * channels**-0.5)
        self.register_buffer("boundaries", torch.zeros(bins - 1))
        self.register_buffer("started", torch.zeros((), dtype=torch.bool))

    def forward(self, features: Tensor, noise: Tensor, m: int) -> tuple[Tensor, Tensor]:
        """Select points.

        Args:
            features: ``(B, N, C)``.
            noise: ``(B, N)`` between 0 and 1, from which the points of a bin are drawn.
            m: number of points.

        Returns:
            Rows ``(B, m)``, and attention ``(B, N, N + bins)`` of points to points and to bins.
        """
        n = features.shape[1]
        tokens = self.tokens.expand(len(features), -1, -1)
        keys = self.keys(torch.cat([features, tokens], 1))
        logits = self.queries(features) @ keys.mT * keys.shape[2] ** -0.5
        attention = logits.softmax(2)
        with torch.no_grad():
            scores = sparse_scores(attention[..., :n], nearest_features(features, self.k))
            scores = scores - scores.mean(1, keepdim=True)
            scores = scores / scores.std(1, keepdim=True, unbiased=False).clamp(min=SMALL)
            if self.training:
                self._move_boundaries(scores)
            bins = (scores[..., None] < self.boundaries).sum(2)
            counts = self._counts(logits[..., n:], bins, m)
            gumbel = -(-noise.clamp(SMALL, 1 - 1e-6).log()).log()
            rows = chosen_rows(scores.tanh() / self.temperature + gumbel, bins, counts)
        return rows, attention

    def _move_boundaries(self, scores: Tensor) -> None:
        """Move the boundaries to those that give bins of equal size in this batch."""
        ordered = scores.flatten().sort(descending=True).values
        number = len(self.boundaries) + 1
        places = torch.arange(1, number, device=scores.device) * len(ordered) // number
        if not self.started:
            self.boundaries.copy_(ordered[places])
            self.started.fill_(True)
        self.boundaries.lerp_(ordered[places], 1 - self.momentum)

    def _counts(self, logits: Tensor, bins: Tensor, m: int) -> Tensor:
        """Return the number of points of every bin, from the logits ``(B, N, bins)``.

        A bin's weight is the mean logit of its points for its token, if it is positive.
        """
        members = nn.functional.one_hot(bins, logits.shape[2]).to(logits)
        available = members.sum(1)
        means = (logits * members).sum(1) / available.clamp(min=1)
        return allot(means.relu(), available, m)


class SAMBLE(Sampler):
    """SAMBLE: input points from bins of attention scores, whose shares are learned by shape.

    Wu et al., "SAMBLE: Shape-Specific Point Cloud Sampling for an Optimal Trade-Off Between Local
    Detail and Global Uniformity", CVPR 2025. The feature net is that of APES. In each of two
    stages, points are scored by the attention that their neighbours pay to them
    (``sparse_scores``), sorted into bins by their score, and drawn from each bin with probabilities
    exp(tanh(score) / temperature). Every bin has a learned token; the mean logit of a bin's points
    for its token says how many of them are kept (``allot``). The boundaries of the bins follow
    those that divide a batch equally. The first stage keeps twice as many points as the second.

    Differences from the publication: there, the stages are inside a classifier, which gets the
    features; here, they select input points for a task net. In training, a selected point has the
    gradient of its attention times the coordinates, to which the attention to tokens adds nothing.
    In evaluation, the draw of a point depends on the cloud only.

    Args:
        m: number of points to select.
        farthest: choose among 4m farthest points, whose features are those in the whole cloud, as
            by an option of the published code; otherwise among all points.
        k: number of neighbours.
        bins: number of bins.
        temperature: of the choice within a bin.
        momentum: of the boundaries between the bins.
        channels: channels of the features.
        heads: heads of the attention to neighbours.

    Raises:
        UserError: an argument is out of range.
    """

    def __init__(
        self,
        m: int,
        farthest: bool = True,
        k: int = 32,
        bins: int = 6,
        temperature: float = 0.1,
        momentum: float = 0.99,
        channels: int = 128,
        heads: int = 4,
    ) -> None:
        super().__init__(m)
        check_at_least(2, k=k, bins=bins)
        check_channels(channels, heads)
        check_at_least(1e-3, temperature=temperature)
        check_at_least(0, momentum=momentum)
        if momentum > 1:
            raise UserError(f"momentum must be at most 1, got {momentum}.")
        self.farthest = farthest
        self.embedding = EdgeEmbedding((64, 64), channels, k)
        self.attention = nn.ModuleList(
            NeighbourAttention(channels, heads, 4, k) for _ in range(STAGES)
        )
        self.sampling = nn.ModuleList(
            BinSampling(channels, bins, k, temperature, momentum) for _ in range(STAGES)
        )
        self.values = nn.Linear(channels, channels, bias=False)

    def sample(self, points: Tensor, m: int) -> SampleOutput:
        """Select points; see ``Sampler.forward``."""
        kept = min(2 * m, points.shape[1])
        candidates = candidate_rows(points, kept, self.farthest)
        features = self.attention[0](self.embedding(points))
        features = gather_points(features, candidates)
        remaining = gather_points(points, candidates)
        first, attention = self.sampling[0](features, self._noise(remaining), kept)
        means = _attended(remaining, attention, first)
        tokens = self.tokens_of_first_stage(len(points))
        features = _attended(self.values(torch.cat([features, tokens], 1)), attention, first)

        features = self.attention[1](features)
        remaining = gather_points(remaining, first)
        soft = straight_through(remaining, means)
        second, attention = self.sampling[1](features, self._noise(remaining), m)
        means = _attended(soft, attention, second)

        rows = candidates.gather(1, first.gather(1, second))
        chosen = gather_points(points, rows)
        if not self.training:
            return SampleOutput(chosen, rows, {})
        return SampleOutput(chosen, rows, {}, soft_projected=straight_through(chosen, means))

    def tokens_of_first_stage(self, clouds: int) -> Tensor:
        """Return the tokens of the first stage's bins, ``(clouds, bins, C)``."""
        layer = self.sampling[0]
        assert isinstance(layer, BinSampling)
        return layer.tokens.expand(clouds, -1, -1)

    def _noise(self, points: Tensor) -> Tensor:
        """Return numbers ``(B, N)`` between 0 and 1: in evaluation hashes of the points."""
        if self.training:
            return torch.rand(points.shape[:2], device=points.device)
        bits = point_hashes(points, 0).bitwise_right_shift(40).bitwise_and(2**24 - 1)
        return (bits.float() + 0.5) / 2**24


def _attended(values: Tensor, attention: Tensor, rows: Tensor) -> Tensor:
    """Return the attention of the selected points times values.

    Args:
        values: ``(B, V, C)``, of the points and perhaps of the bins behind them.
        attention: ``(B, N, N + bins)``.
        rows: ``(B, M)`` the selected points.

    Returns:
        ``(B, M, C)``.
    """
    return gather_points(attention, rows)[..., : values.shape[1]] @ values
