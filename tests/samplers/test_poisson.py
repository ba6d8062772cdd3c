import torch

from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.samplers.poisson import PoissonSampler
from mops_lightning.samplers.random import RandomSampler


def test_poisson_of_points_with_gradients_equals_points_without(rng):
    points = torch.randn(1, 30, 3, generator=rng, dtype=torch.float64)
    found = PoissonSampler(5)(points.clone().requires_grad_())
    assert torch.equal(found.indices, PoissonSampler(5)(points).indices)


def spacing(points):
    distances = torch.cdist(points, points)
    distances.diagonal(dim1=1, dim2=2).fill_(torch.inf)
    return distances.amin((1, 2)).mean()


def test_poisson_is_more_even_than_random(rng):
    flat = torch.rand(8, 600, 3, generator=rng) * torch.tensor([1.0, 1.0, 0.0])
    even = spacing(PoissonSampler(60)(flat).points)
    assert even > 4 * spacing(RandomSampler(60)(flat).points)
    assert even > 0.8 * spacing(FPSSampler(60)(flat).points)
