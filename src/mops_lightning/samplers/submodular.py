"""Greedy selection of the points that cover the task net's max-pooled features."""

import torch
from torch import Tensor

from mops_lightning.samplers.task_net import TaskNetSampler

SHORTLIST = 16
"""Points per cloud whose gains are computed together."""


class SubmodularSampler(TaskNetSampler):
    """Choose points whose max-pooled features are close to the full cloud's, without training.

    With f_ic the feature c of point i, points are chosen greedily so that Σ_c max_i f_ic over the
    chosen points grows most (``facility_location``). Once the maxima equal the full cloud's,
    farthest points follow. Flexible and nested.

    Args:
        m: largest number of points to return.
        net: the task net, see ``TaskNetSampler``.
        seed: breaks ties.

    Raises:
        UserError: ``net`` is missing or unsuitable.

    Examples:
        >>> import torch
        >>> from mops_lightning import SubmodularSampler
        >>> from mops_lightning.nets.pointnet import PointNetVanilla
        >>> net = PointNetVanilla(num_classes=40)
        >>> SubmodularSampler(m=8, net=net)(torch.rand(2, 64, 3)).indices.shape  # (B, m)
        torch.Size([2, 8])
    """

    def choose(self, features: Tensor, m: int) -> tuple[Tensor, Tensor]:
        """Choose points greedily; see ``TaskNetSampler.choose``."""
        return facility_location(features, m)


@torch.no_grad()
def facility_location(features: Tensor, m: int) -> tuple[Tensor, Tensor]:
    """Choose points greedily so that Σ_c max_i f_ic over the chosen points i grows most.

    This sum is a monotone submodular function of the chosen set. The greedy choice therefore
    reaches at least 1 - 1/e of the best value of its size (Nemhauser, Wolsey and Fisher,
    Mathematical Programming 1978), and the gain of a point never grows. The lazy form (Minoux,
    1978) uses this: a gain that was computed earlier is an upper bound, and only points with the
    largest bounds are evaluated again.

    Args:
        features: ``(B, N, C)``, non-negative.
        m: largest number of points to choose, 1 ≤ m ≤ N.

    Returns:
        ``(B, m)`` int64 rows in the order of choice, and ``(B,)`` int64 how many of them were
        chosen, at least one. A cloud has fewer than m when no other point has a gain; the
        remaining entries are 0.
    """
    clouds = len(features)
    chosen = torch.zeros(clouds, m, dtype=torch.int64, device=features.device)
    counts = torch.full((clouds,), m, device=features.device)
    covered = torch.zeros_like(features[:, 0])
    bounds = features.sum(2)
    active = torch.arange(clouds, device=features.device)
    for step in range(m):
        best = _best(features, covered, bounds, active)
        gains = bounds[active, best]
        if step:
            counts[active[gains <= 0]] = step
            active, best = active[gains > 0], best[gains > 0]
            if len(active) == 0:
                break
        chosen[active, step] = best
        covered[active] = torch.maximum(covered[active], features[active, best])
        bounds[active, best] = 0.0  # it has nothing more to add
    return chosen, counts


def _best(features: Tensor, covered: Tensor, bounds: Tensor, active: Tensor) -> Tensor:
    """Return the point with the largest gain in each active cloud, and tighten its bounds.

    Args:
        features: ``(B, N, C)``.
        covered: ``(B, C)`` the maxima over the chosen points.
        bounds: ``(B, N)`` upper bounds of the gains; for evaluated points replaced by the gains.
        active: ``(A,)`` the clouds to look at.

    Returns:
        ``(A,)`` int64.
    """
    best = torch.empty_like(active)
    pending = torch.arange(len(active), device=active.device)
    while len(pending):
        cloud = active[pending]
        rows = bounds[cloud].topk(min(SHORTLIST, bounds.shape[1])).indices
        # In case of ties, topk may leave out the one that decides; evaluating it ends the loop.
        first = bounds[cloud].argmax(1)
        listed = (rows == first[:, None]).any(1)
        rows[:, -1] = torch.where(listed, rows[:, -1], first)
        gains = (features[cloud[:, None], rows] - covered[cloud][:, None]).relu_().sum(2)
        bounds[cloud[:, None], rows] = gains
        top = bounds[cloud].argmax(1)
        done = (rows == top[:, None]).any(1)
        best[pending[done]] = top[done]
        pending = pending[~done]
    return best
