import pytest
import torch
from torch.testing import assert_close

from mops_lightning.samplers.gumbel import GumbelSampler


@pytest.fixture
def sampler():
    return GumbelSampler(4, feature_channels=(8, 6))


def test_gumbel_evaluation_chooses_largest_score(sampler, randn):
    points = randn(3, 20, 3)
    sampler.eval()
    chosen = sampler(points).points
    for cloud, scores, got in zip(points, sampler.scores(points), chosen, strict=True):
        assert torch.equal(got, cloud[[int(row.argmax()) for row in scores]])


def test_gumbel_training_means_are_frequencies_of_choice(sampler, randn):
    """At a low temperature, a point is chosen with its probability under softmax of the scores."""
    cloud = randn(40, 3)
    points = cloud.expand(1000, -1, -1)
    sampler.training_tau = 1e-4
    scores = sampler.scores(points)[0, 0]
    assert scores.softmax(0).max() > 4 / 40  # the probabilities differ
    distances = (sampler(points).points[:, :1] - cloud).norm(dim=2)
    assert distances.amin(1).median() < 1e-6
    counts = distances.argmin(1).bincount(minlength=40)
    assert_close(counts / 1000, scores.softmax(0), atol=0.06, rtol=0)


def test_gumbel_training_has_gradients(sampler, randn):
    sampler(randn(3, 20, 3)).points.square().sum().backward()
    assert all(p.grad is not None and p.grad.any() for p in sampler.parameters())


def test_gumbel_anneals_exponentially(sampler):
    taus = []
    for progress in (0.0, 0.5, 1.0, 2.0):
        sampler.anneal(progress)
        taus.append(sampler.tau)
    assert taus == pytest.approx([1, 0.1**0.5, 0.1, 0.1])
    assert sampler.eval().tau == 0.1
