"""Selection by scores: a base class of samplers, and the differentiable choice of k."""

import torch
from torch import Tensor

from mops_lightning.errors import check_at_least
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.ordering import seeded_order
from mops_lightning.types import SampleOutput


class Selector(Sampler):
    """Base class of samplers that select points by scores; implements thinning before a test.

    A point is selected for a score above those of all other points: the same net chooses other
    places from a denser cloud. In evaluation, larger clouds are therefore thinned at random to
    about the number of points that ``recipe.train_points`` lets training see.

    Args:
        m: number of points to select.
        candidates: number of points to select from in evaluation; None: all.
    """

    def __init__(self, m: int, candidates: int | None) -> None:
        super().__init__(m)
        check_at_least(m, candidates=m if candidates is None else candidates)
        self.candidates = candidates

    def sample(self, points: Tensor, m: int) -> SampleOutput:
        """Select points; see ``Sampler.forward``."""
        if self.training or self.candidates is None:
            return self.select_rows(points, m)
        rows = seeded_order(points, 0)[:, : self.candidates]
        output = self.select_rows(gather_points(points, rows), m)
        assert output.indices is not None
        return output._replace(indices=rows.gather(1, output.indices))

    def select_rows(self, points: Tensor, m: int) -> SampleOutput:
        """Select from all points; arguments and result as for ``sample``."""
        raise NotImplementedError


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
