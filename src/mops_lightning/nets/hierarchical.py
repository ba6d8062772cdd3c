"""Hierarchical nets whose stages sample their points: a classifier and a segmentation net.

The paper's conclusion proposes its sampler in place of farthest point sampling inside such nets,
of which PointNet++ is the first (Qi et al., NeurIPS 2017).
"""

import inspect
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mops_lightning.channels import PointChannels, coordinates
from mops_lightning.errors import UserError, check_at_least
from mops_lightning.nets.layers import PointMLP, check_channels, linear_norm_relu
from mops_lightning.ops.maxima import max_of_rows
from mops_lightning.ops.moments import neighbourhood_moments
from mops_lightning.ops.nearest import k_nearest_rows, nearest
from mops_lightning.ops.points import gather_points
from mops_lightning.ops.propagation import interpolate
from mops_lightning.types import SampleOutput


@runtime_checkable
class FeatureSampler(Protocol):
    """A sampler that reads the features of the net whose stage it samples for."""

    def by_features(self, points: Tensor, features: Tensor, m: int) -> SampleOutput:
        """Return m of the points ``(B, N, 3)`` with features ``(B, N, C)``."""


@runtime_checkable
class LossInStage(Protocol):
    """A sampler whose losses need the distances to the nearest points, which a stage knows."""

    def losses_in_stage(self, output: SampleOutput, squares: Tensor) -> dict[str, Tensor]:
        """Return the weighted losses of a training step.

        Args:
            output: of the sampler.
            squares: ``(B, m)`` squared distances of its points to the nearest input points.
        """


class Stage(nn.Module):
    """Samples centres q_i and gathers the features of their neighbourhoods.

    y_i = relu(BN(max_j (A·f_j + B·o_ij) + C·c_i + D·s_i)) over the k points p_j nearest to q_i,
    then y_i + MLP(y_i). f_j is the feature of p_j and c_i the feature of the centre, see
    ``carried``. The offset o_ij is (p_j − q_i)/r, where r is the root mean square of the distances
    ‖p_j − q_i‖ of a cloud, so that offsets are of one size in all stages; PointNeXt (Qian et al.,
    NeurIPS 2022) divides them by a fixed radius. s_i, the means of o_ij and of the products of its
    coordinates, describes the plane of the neighbourhood. As A and B are linear, only A·f_j +
    B·p_j/r depends on j, so that no tensor of all edges' features is made. A sampler may name the
    neighbourhoods itself (``SampleOutput.neighbours``), which saves the search for them.

    Args:
        sampler: returns the centres.
        m: number of centres; of clouds with fewer points, a flexible sampler returns all. Training
            steps take the largest of the sampler's ``training_sizes``.
        channels_in: channels of f.
        channels_out: channels of the result.
        k: number of neighbours; all points if there are fewer.
    """

    def __init__(
        self,
        sampler: nn.Module,
        m: int,
        channels_in: int,
        channels_out: int,
        k: int,
    ) -> None:
        super().__init__()
        self.sampler: Any = sampler
        self.m = m
        self.k = k
        self.feature = nn.Linear(channels_in, channels_out, bias=False)
        self.offset = nn.Linear(3, channels_out, bias=False)
        self.centre = nn.Linear(channels_in, channels_out, bias=False)
        self.moments = nn.Linear(12, channels_out, bias=False)
        self.norm = nn.BatchNorm1d(channels_out)
        self.mlp = PointMLP([channels_out, channels_out])
        self.losses: dict[str, Tensor] = {}
        """The sampler's losses in the last training step."""

    def forward(self, points: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
        """Map ``(B, N, 3)`` points and ``(B, N, channels_in)`` features to m of each.

        Raises:
            UserError: the stage's sampler returns m points only, and N is below m.
        """
        n = points.shape[1]
        is_flexible = getattr(self.sampler, "flexible", True)
        if n < self.m and not is_flexible:
            raise UserError(
                f"task.net.points must be at most the {n} points that the net is given, because "
                f"its {type(self.sampler).__name__} returns {self.m} points only. Lower it, or "
                "choose sampler@task.net.sampler=fps."
            )
        output = self._sampled(points, features)
        centres = output.points
        rows = self._neighbours(output, points)
        self.losses = output.losses
        if self.training and isinstance(self.sampler, LossInStage):
            _, nearest_row = nearest(centres, points)
            squares = (centres - gather_points(points, nearest_row)).square().sum(2)
            self.losses = self.sampler.losses_in_stage(output, squares)
        offset_moments = neighbourhood_moments(points, centres, rows)
        r = root_mean_square(offset_moments)
        scale = torch.cat([r, r, r, *[r * r] * 9], 2)
        edges = max_of_rows(self.feature(features) + self.offset(points / r), rows)
        edges = edges - self.offset(centres / r)
        edges = edges + self.centre(carried(output, points, features))
        edges = edges + self.moments(offset_moments / scale)
        activated = F.relu(self.norm(edges.flatten(0, 1)))
        mixed = activated.unflatten(0, centres.shape[:2])
        return centres, mixed + self.mlp(mixed).to(mixed)

    def _neighbours(self, output: SampleOutput, points: Tensor) -> Tensor:
        """Return the rows ``(B, M, k)`` of the neighbourhoods of sampled points."""
        k = min(self.k, points.shape[1])
        if output.neighbours is not None and output.neighbours.shape[2] >= k:
            return output.neighbours[..., :k]
        return k_nearest_rows(output.points, points, k)

    def _sampled(self, points: Tensor, features: Tensor) -> SampleOutput:
        sizes = (self.m,)
        if self.training:
            sizes = self.sampler.training_sizes()
        m = min(max(sizes), points.shape[1])
        if isinstance(self.sampler, FeatureSampler):
            return self.sampler.by_features(points, features, m)
        return self.sampler(points, m)


def root_mean_square(offset_moments: Tensor) -> Tensor:
    """Return the root mean square ``(B, 1, 1)`` of the lengths of all offsets of a cloud.

    Args:
        offset_moments: ``(B, M, 12)`` from ``neighbourhood_moments``.
    """
    products = offset_moments[..., 3:].unflatten(2, (3, 3))
    squares = products.diagonal(dim1=2, dim2=3).sum(2)
    mean = squares.mean(1)[:, None, None]
    return torch.where(mean > 0, mean, 1.0).sqrt()  # all points may coincide


def carried(output: SampleOutput, points: Tensor, features: Tensor) -> Tensor:
    """Return the features ``(B, M, C)`` of sampled points.

    Input points keep theirs. Points generated by a sampling matrix S get SᵀF, as their coordinates
    are SᵀP (paper Eq. 6), other generated points the feature of the nearest input point.

    Args:
        output: of a sampler.
        points: ``(B, N, 3)`` its input.
        features: ``(B, N, C)`` of these points.
    """
    if output.indices is not None:
        return gather_points(features, output.indices)
    if output.matrix is not None:
        values = features.to(output.matrix.dtype)
        return output.matrix.sample(values).to(features)
    _, rows = nearest(output.points, points)
    return gather_points(features, rows)


class Hierarchy(nn.Module):
    """Stages that sample and look at neighbourhoods; base of the nets of this module.

    Args:
        sampler: makes the sampler of a stage from its number of points, given as ``m_max`` if it
            takes that, otherwise as ``m``, and the ``channels`` of the points' features if it takes
            these.
        points: number of points after every stage.
        channels: channels of the features before the first stage and after every stage.
        k: number of neighbours.
        point_channels: channels of the points, or their number; the first features are computed
            from them and the coordinates.

    Raises:
        UserError: an argument is out of range.
    """

    def __init__(
        self,
        sampler: Callable[..., nn.Module],
        points: Sequence[int],
        channels: Sequence[int],
        k: int,
        point_channels: PointChannels | int = 0,
    ) -> None:
        super().__init__()
        self.point_channels = PointChannels.of(point_channels)
        check_at_least(1, k=k)
        check_channels("points", points)
        check_channels("channels", channels)
        if list(points) != sorted(points, reverse=True):
            raise UserError(f"points must not increase from stage to stage, got {list(points)}.")
        if len(channels) != len(points) + 1:
            raise UserError(
                f"channels must have one number more than the {len(points)} of points, got "
                f"{len(channels)}."
            )
        accepted = inspect.signature(sampler).parameters
        size = "m"
        if "m_max" in accepted:
            size = "m_max"
        first = channels[0]
        input_channels = 3 + len(self.point_channels)
        self.stem = PointMLP([input_channels, first, first])
        stages = []
        for m, (before, after) in zip(points, pairwise(channels), strict=True):
            settings = {size: m}
            if "channels" in accepted:
                settings["channels"] = before
            stages.append(Stage(sampler(**settings), m, before, after, k))
        self.stages = nn.ModuleList(stages)

    def levels(self, points: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return places ``(B, M, 3)`` and their features ``(B, M, C)``: the input, every stage."""
        features = self.stem(points).to(points)
        levels = [(coordinates(points), features)]
        for stage in self.stages:
            levels.append(stage(*levels[-1]))
        return levels

    @property
    def losses(self) -> dict[str, Tensor]:
        """The losses of the stages' samplers in the last training step, by stage and name."""
        losses: dict[str, Tensor] = {}
        for i, stage in enumerate(self.stages, 1):
            assert isinstance(stage, Stage)
            for name, loss in stage.losses.items():
                losses[f"stage{i}_{name}"] = loss
        return losses


class HierarchicalNet(Hierarchy):
    """A classifier: stages, the maximum of every stage's features and the mean of the last.

    Args:
        num_classes: number of logits.
        sampler: makes the sampler of a stage; see ``Hierarchy``.
        points: number of points after every stage.
        channels: channels of the features before the first stage and after every stage.
        k: number of neighbours.
        hidden: channels between the pooled features and the logits.
        dropout: dropout probability.
        point_channels: channels of the points, or their number.

    Raises:
        UserError: an argument is out of range.
    """

    def __init__(
        self,
        num_classes: int,
        sampler: Callable[..., nn.Module],
        points: Sequence[int] = (512, 256, 128, 64),
        channels: Sequence[int] = (24, 32, 64, 96, 160),
        k: int = 16,
        hidden: int = 96,
        dropout: float = 0.3,
        point_channels: PointChannels | int = 0,
    ) -> None:
        super().__init__(sampler, points, channels, k, point_channels)
        check_at_least(1, hidden=hidden)
        pooled = sum(channels[1:]) + channels[-1]
        self.head = nn.Sequential(
            *linear_norm_relu([pooled, hidden]),
            nn.Dropout(dropout),
            nn.Linear(hidden, num_classes),
        )

    def forward(self, points: Tensor) -> Tensor:
        """Map ``(B, N, 3 + C)`` points to ``(B, num_classes)`` logits."""
        stages = self.levels(points)[1:]
        peaks = [features.amax(1) for _, features in stages]
        _, deepest = stages[-1]
        return self.head(torch.cat([*peaks, deepest.mean(1)], 1))


class HierarchicalSegmentation(Hierarchy):
    """A segmentation net: stages, and back through them to the points of the input.

    On the way back, features of a stage are interpolated to the points before it, joined with the
    features that these points have, and mapped by a pointwise layer, as in PointNet++.

    Args:
        num_parts: number of logits of a point. The other arguments are those of
            ``HierarchicalNet``.

    Raises:
        UserError: an argument is out of range.
    """

    def __init__(
        self,
        num_parts: int,
        sampler: Callable[..., nn.Module],
        points: Sequence[int] = (256, 64),
        channels: Sequence[int] = (32, 64, 128),
        k: int = 16,
        dropout: float = 0.3,
        point_channels: PointChannels | int = 0,
    ) -> None:
        super().__init__(sampler, points, channels, k, point_channels)
        # The deepest level also knows the whole cloud, by the maximum of its features.
        sizes = [2 * channels[-1], *reversed(channels[:-1])]
        layers = [PointMLP([deep + skip, skip]) for deep, skip in pairwise(sizes)]
        self.back = nn.ModuleList(layers)
        last = nn.Linear(channels[0], num_parts)
        self.head = nn.Sequential(nn.Dropout(dropout), last)

    def forward(self, points: Tensor) -> Tensor:
        """Map ``(B, N, 3 + C)`` points to ``(B, N, num_parts)`` logits."""
        *before, (centres, features) = self.levels(points)
        peaks = features.amax(1, keepdim=True).expand_as(features)
        features = torch.cat([features, peaks], 2)
        before.reverse()
        for layer, (target, skip) in zip(self.back, before, strict=True):
            carried_back = interpolate(features, centres, target)
            both = torch.cat([carried_back, skip], 2)
            features = layer(both).to(points)
            centres = target
        return self.head(features)
