"""Local search: exchange points of a sample so that a function of its pooled features falls."""

from collections.abc import Callable

import torch
from torch import Tensor

from mops_lightning.ops.points import gather_points

SHORTLIST = 16
"""Candidates for each place of a sample that are scored exactly."""
MIN_GAIN = 1e-3
"""Smallest relative improvement for which points are exchanged."""
ROUNDING = 1e-9
"""Improvements up to here are rounding errors."""


@torch.no_grad()
def refine(
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
