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

    scores = sampler.scores(points)
    for cloud in range(3):
        for column in range(4):
            best = scores[cloud, column].argmax()
            assert torch.equal(chosen[cloud, column], points[cloud, best])


def test_gumbel_training_means_are_frequencies_of_choice(sampler, randn):
    """At a low temperature, a point is chosen with its probability under softmax of the scores."""
    cloud = randn(40, 3)
    points = cloud.expand(1000, -1, -1)
    sampler.training_tau = 1e-4

    first = sampler(points).points[:, 0]

    probabilities = sampler.scores(points)[0, 0].softmax(0)
    assert probabilities.max() > 4 / 40  # they differ
    distances, rows = torch.cdist(first, cloud).min(1)
    assert distances.median() < 1e-4
    frequencies = rows.bincount(minlength=40) / 1000
    assert_close(frequencies, probabilities, atol=0.06, rtol=0)


def test_gumbel_training_means_are_a_softmax_of_noisy_scores_over_the_temperature(sampler, randn):
    points = randn(3, 20, 3)
    sampler.training_tau = 0.5
    sampler.scores(points)  # running statistics do not matter in training
    torch.manual_seed(7)

    generated = sampler(points).points

    torch.manual_seed(7)
    scores = sampler.scores(points)
    noise = -torch.empty_like(scores).exponential_().log()
    weights = torch.softmax((scores + noise) / 0.5, 2)
    assert_close(generated, weights @ points)


def test_gumbel_training_has_gradients(sampler, randn):
    generated = sampler(randn(3, 20, 3)).points
    generated.square().sum().backward()

    for weights in sampler.parameters():
        assert weights.grad is not None
        assert weights.grad.any()


def test_gumbel_anneals_exponentially(sampler):
    taus = []
    for progress in (-1.0, 0.0, 0.5, 1.0, 2.0):
        sampler.anneal(progress)
        taus.append(sampler.tau)

    middle = 0.1**0.5
    assert taus == pytest.approx([1, 1, middle, 0.1, 0.1])
    assert sampler.eval().tau == 0.1
