"""What samplers that select points by scores share: candidates, and gradients of a selection."""

import torch
from torch import Tensor

from mops_lightning.ops.farthest import FARTHEST
from mops_lightning.samplers.fps import farthest_rows


def candidate_rows(points: Tensor, kept: int, farthest: bool) -> Tensor:
    """Return the rows ``(B, K)`` of the points among which a stage chooses.

    Args:
        points: ``(B, N, 3)``.
        kept: number of points that the stage keeps.
        farthest: choose among twice as many farthest points, if there are more points than these;
            otherwise among all.
    """
    clouds, n, _ = points.shape
    if farthest and 2 * kept < n:
        return farthest_rows(points, 2 * kept, start=FARTHEST)
    return torch.arange(n, device=points.device).expand(clouds, n)


def straight_through(chosen: Tensor, means: Tensor) -> Tensor:
    """Return selected points with the gradient of means.

    Args:
        chosen: ``(B, M, 3)`` the selected points.
        means: ``(B, M, 3)`` weighted means that depend on the scores.
    """
    return chosen + means - means.detach()


def soft_top_k(scores: Tensor, k: int, epsilon: float, iterations: int = 20) -> Tensor:
    """Return to what degree each score is among the k largest of its cloud.

    The degree is N times the second column of the entropic optimal transport plan between the
    scores, each of mass 1/N, and the places 0 and 1 of masses (N − k)/N and k/N, at squared cost
    (Xie et al., "Differentiable Top-k with Optimal Transport", 2020), by Sinkhorn's iterations.

    Args:
        scores: ``(B, N)``.
        k: number of scores to choose, below N.
        epsilon: weight of the entropy; the degrees approach 0 and 1 as it falls.
        iterations: number of iterations.

    Returns:
        ``(B, N)``, from 0 to 1; a cloud's sum is k at convergence.
    """
    n = scores.shape[1]
    places = scores.new_tensor([0.0, 1.0])
    logits = -(scores[..., None] - places).square() / epsilon
    masses = scores.new_tensor([(n - k) / n, k / n]).log()
    columns = torch.zeros_like(logits[:, :1])
    # Start from degree 1/2 at the k-th largest score: far from it, small epsilons converge slowly.
    columns[..., 1] = (1 - 2 * scores.detach().topk(k).values[:, -1:]) / epsilon
    for _ in range(iterations):
        rows = -(logits + columns).logsumexp(2, keepdim=True)
        columns = masses + scores.new_tensor(n).log() - (logits + rows).logsumexp(1, keepdim=True)
    return (logits + columns).softmax(2)[..., 1]
