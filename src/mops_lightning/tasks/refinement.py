"""The refined readout: samples improved by local search with the frozen task net."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from mops_lightning.errors import UserError
from mops_lightning.ops.points import gather_points
from mops_lightning.tasks.base import Task
from mops_lightning.types import PointFeatureNet

BATCH_POINTS = 32768
"""Number of points of one side whose features are in memory together; at least one cloud."""
SHORTLIST = 16
"""Candidates for each place of a sample that are scored exactly."""
MIN_GAIN = 1e-3
"""Smallest relative improvement for which points are exchanged."""
ROUNDING = 1e-9
"""Improvements up to here are rounding errors."""


class Refinement:
    """Exchanges points of samples until the task net predicts nearly the same as for all points.

    It needs no labels, but runs the task net on the full cloud: scores of refined samples are a
    bound for what m input points can give this net. See ``improve`` for the search. Where a
    prediction needs two clouds, the sources are refined for the whole targets, then the targets for
    the refined sources.

    Args:
        task: its ``disagreement`` is minimised; the net is used as it is, in evaluation mode.
        refine: largest number of passes over the places of a sample.

    Raises:
        UserError: the prediction does not follow from the maxima of a sample's features.
    """

    def __init__(self, task: Task, refine: int) -> None:
        if task.maps_pooled is None:
            raise UserError(
                f"refine must be 0 for {type(task).__name__.lower()}, got {refine}: its prediction "
                "does not follow from the features of a sample (maps_pooled)."
            )
        suits = isinstance(task.net, PointFeatureNet) and hasattr(task.net, task.maps_pooled)
        if not suits or not getattr(task.net, "pools_points", True):
            raise UserError(
                f"refine must be 0 with this {type(task.net).__name__}, got {refine}: its result "
                "does not follow from features of single points under a maximum. Such nets are "
                "pointnet for classification, pcrnet with iterations=1 for registration, and "
                "autoencoder, atlasnet or mfoldingnet for reconstruction."
            )
        self.task = task
        self.passes = refine

    def __call__(self, batch: Any, samples: Mapping[int, Tensor]) -> dict[int, Tensor]:
        """Refine the samples of a batch.

        Args:
            batch: clouds ``(B, N, 3)``, or pairs of ``(2B, N, 3)``.
            samples: by size m, distinct rows ``(B, m)`` or ``(2B, m)`` of the clouds.

        Returns:
            The same sizes with other rows of the same shape, distinct.
        """
        # Lightning tests in inference mode, whose tensors cannot be differentiated.
        with torch.inference_mode(False), torch.no_grad():
            parts = []
            count = max(1, BATCH_POINTS // batch.points.shape[1])
            for start in range(0, batch.num_clouds, count):
                chosen = slice(start, start + count)
                sides = [side[chosen].clone() for side in self._sides(batch.points)]
                rows = {
                    m: [side[chosen].clone() for side in self._sides(indices)]
                    for m, indices in samples.items()
                }
                parts.append(self._refined(batch, sides, rows))
        order = range(self.task.clouds_per_prediction)
        return {m: torch.cat([part[m][side] for side in order for part in parts]) for m in samples}

    def _sides(self, tensor: Tensor) -> tuple[Tensor, ...]:
        """Split what all clouds have into the first clouds of the predictions, and so on."""
        return tensor.chunk(self.task.clouds_per_prediction)

    def _refined(
        self, batch: Any, sides: Sequence[Tensor], samples: Mapping[int, Sequence[Tensor]]
    ) -> dict[int, list[Tensor]]:
        net = self.task.net
        assert isinstance(net, PointFeatureNet)
        features = [net.point_features(points) for points in sides]
        whole = [each.amax(1) for each in features]
        wanted = predict_pooled(self.task, batch, torch.cat(whole))
        result: dict[int, list[Tensor]] = {}
        for m, rows in samples.items():
            # One side after the other; what is not refined yet is the whole cloud.
            pooled, result[m] = list(whole), []
            for side, (own, indices) in enumerate(zip(features, rows, strict=True)):
                apart = partial(self._apart, batch, wanted, pooled, side)
                refined = improve(own, indices, apart, self.passes)
                pooled[side] = gather_points(own, refined).amax(1)
                result[m].append(refined)
        return result

    def _apart(
        self,
        batch: Any,
        wanted: Any,
        pooled: Sequence[Tensor],
        side: int,
        candidates: Tensor,
        cloud: Tensor,
    ) -> Tensor:
        """Return the disagreement when one side has other pooled features ``(R, C)``."""
        both = [candidates if i == side else each[cloud] for i, each in enumerate(pooled)]
        found = predict_pooled(self.task, batch, torch.cat(both))
        return self.task.disagreement(found, _take(wanted, cloud))


def predict_pooled(task: Task, batch: Any, pooled: Tensor) -> Any:
    """Return the prediction of a task from maxima over the net's ``point_features``.

    Args:
        task: with ``maps_pooled``.
        batch: from ``make_batch``.
        pooled: ``(R, C)``, in the order of the points.
    """
    sizes = (batch.points.shape[1],) if "n_points" in task.net_takes else ()
    return getattr(task.net, str(task.maps_pooled))(
        *pooled.chunk(task.clouds_per_prediction), *sizes
    )


def _take(prediction: Any, rows: Tensor) -> Any:
    """Return rows of a prediction, a tensor or a tuple of tensors such as ``Motion``."""
    if isinstance(prediction, Tensor):
        return prediction[rows]
    return type(prediction)(*(part[rows] for part in prediction))


@torch.no_grad()
def improve(
    features: Tensor, indices: Tensor, objective: Callable[[Tensor, Tensor], Tensor], passes: int
) -> Tensor:
    """Exchange points of every sample one by one, each time for the best point not in the sample.

    A pass visits every place of the sample. Candidates for a place come from a first-order
    estimate: the gradient of the objective at the pooled features at the beginning of the pass,
    times the change of these features by the exchange. They are then scored exactly. A cloud in
    which a pass exchanges nothing is finished.

    Args:
        features: ``(B, N, C)``, non-negative; a sample is pooled by the maximum over its rows.
        indices: ``(B, M)`` int64, distinct rows of the sample.
        objective: maps pooled features ``(R, C)`` and their clouds ``(R,)`` to values ``(R,)`` to
            minimise; differentiable in the first argument.
        passes: largest number of passes.

    Returns:
        ``(B, M)`` int64, distinct; no objective is larger than for ``indices``.
    """
    indices = indices.clone()
    if indices.shape[1] == features.shape[1]:
        return indices  # no other points
    active = torch.arange(len(features), device=features.device)
    for _ in range(passes):
        improved = _one_pass(features[active], indices[active], objective, active)
        changed = (improved != indices[active]).any(1)
        indices[active] = improved
        active = active[changed]
        if len(active) == 0:
            break
    return indices


def _one_pass(
    features: Tensor, indices: Tensor, objective: Callable[[Tensor, Tensor], Tensor], cloud: Tensor
) -> Tensor:
    """Visit every place of the samples once; ``cloud`` ``(B,)`` is passed to the objective."""
    indices = indices.clone()
    chosen = gather_points(features, indices)
    with torch.enable_grad():
        pooled = chosen.amax(1).requires_grad_()
        value = objective(pooled, cloud)
        (gradient,) = torch.autograd.grad(value.sum(), pooled)
    value = value.detach()
    shortlist = _shortlist(features, indices, chosen, gradient)
    # Maxima over the places that follow and, as they are visited, over those before.
    behind = chosen.flip(1).cummax(1).values.flip(1)
    before = torch.zeros_like(pooled)
    every = torch.arange(len(features), device=features.device)
    count = shortlist.shape[2]
    for place in range(indices.shape[1]):
        rest = before if place + 1 == behind.shape[1] else before.maximum(behind[:, place + 1])
        candidates = shortlist[:, place]
        pooled = rest[:, None].maximum(gather_points(features, candidates)).flatten(0, 1)
        values = objective(pooled, cloud.repeat_interleave(count)).unflatten(0, (-1, count))
        # An earlier place of this pass may have taken a candidate.
        taken = (candidates[:, :, None] == indices[:, None]).any(2)
        best, which = values.masked_fill(taken, torch.inf).min(1)
        better = best < value - (MIN_GAIN * value.abs()).clamp(min=ROUNDING)
        new = candidates[every, which]
        indices[:, place] = torch.where(better, new, indices[:, place])
        value = torch.where(better, best, value)
        before = before.maximum(features[every, indices[:, place]])
    return indices


def _shortlist(features: Tensor, indices: Tensor, chosen: Tensor, gradient: Tensor) -> Tensor:
    """Return the candidates with the lowest estimates for every place, ``(B, M, K)``."""
    estimates = features.new_empty(*indices.shape, features.shape[1])
    for number, cloud in enumerate(zip(features, chosen, gradient, strict=True)):
        estimates[number] = estimated_changes(*cloud)
    members = indices[:, None].expand(-1, indices.shape[1], -1)
    estimates.scatter_(2, members, torch.inf)
    count = min(SHORTLIST, features.shape[1])
    return estimates.topk(count, dim=2, largest=False).indices


def estimated_changes(features: Tensor, chosen: Tensor, gradient: Tensor) -> Tensor:
    """Estimate the change of the objective when row i replaces place j of one sample.

    The estimate is Σ_c g_c (max(r_jc, f_ic) − p_c) for the gradient g, the pooled features p and
    the maxima r_j over all places but j. As r_jc differs from p_c only where j wins channel c, it
    is the sum over all channels for r = p, plus a correction over the channels that j wins: two
    passes over the features instead of m.

    Args:
        features: ``(N, C)``.
        chosen: ``(M, C)`` the features of the sample.
        gradient: ``(C,)``.

    Returns:
        ``(M, N)``.
    """
    largest, winner = chosen.max(0)
    second = chosen.scatter(0, winner[None], -1.0).amax(0).clamp_(min=0)  # without the winner
    channels = features.T.contiguous()
    peak, floor, slope = largest[:, None], second[:, None], gradient[:, None]
    lost = channels.clamp(floor, peak).sub_(peak).mul_(slope)
    estimate = features.new_zeros(len(chosen), len(features)).index_add_(0, winner, lost)
    return estimate.add_(gradient @ channels.sub_(peak).relu_())
