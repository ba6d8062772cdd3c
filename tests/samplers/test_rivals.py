from importlib import import_module
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir

from mops_lightning.config.build import build
from mops_lightning.config.compose import conf_dir

# From the root, as sampler=NAME finds them.
lightn = import_module("benchmarks.rivals.lightn")
csnet = import_module("benchmarks.rivals.csnet")
apes = import_module("benchmarks.rivals.apes")


@pytest.mark.parametrize("choice", ["lightn", "csnet", "apes", "apes sampler.variant=global"])
def test_rival_trains_every_weight_and_ignores_order_of_points(choice, rng):
    settings = [f"hydra.searchpath=[file://{conf_dir()}]", "m=6", *f"sampler={choice}".split()]
    with initialize_config_dir(str(Path(__file__).parents[2] / "sweeps"), version_base="1.3"):
        sampler = build(compose("noise", settings).sampler, "sampler")
    points, order = torch.randn(3, 50, 3, generator=rng), torch.randperm(50, generator=rng)
    output = sampler(points)
    seen = output.points if output.soft_projected is None else output.soft_projected
    (seen.square().sum() + sum(output.losses.values())).backward()
    assert all(p.grad is not None and p.grad.any() for p in sampler.parameters())
    chosen, turned = sampler.eval()(points), sampler(points[:, order])
    assert chosen.points.shape == (3, 6, 3)
    torch.testing.assert_close(turned.points, chosen.points, atol=1e-4, rtol=1e-4)
    assert sampler.generates or torch.equal(order[turned.indices], chosen.indices)


def test_self_correlation_equals_plain_sums(rng):
    cloud = torch.randn(7, 4, generator=rng)
    for row, got in zip(cloud, lightn.self_correlation(cloud[None])[0], strict=True):
        shares = (cloud * row).sum(1).div(2).exp()
        torch.testing.assert_close(got, (shares[:, None] * cloud).sum(0) / shares.sum())


def test_soft_top_k_is_sigmoid_above_threshold_that_gives_k(rng):
    scores, low, high = torch.randn(40, generator=rng), -50.0, 50.0
    for _ in range(60):
        middle = (low + high) / 2
        degrees = (2 * scores / 0.5 - middle).sigmoid()
        low, high = (middle, high) if degrees.sum() > 9 else (low, middle)
    got = csnet.soft_top_k(scores[None], 9, 0.5, iterations=200)[0]
    torch.testing.assert_close(got, degrees, atol=1e-4, rtol=0)


@pytest.mark.parametrize("variant", ["local", "global"])
def test_apes_scores_equal_plain_attention(variant, rng):
    points = torch.randn(1, 20, 3, generator=rng)
    sampler = apes.APES(5, variant, k=4, feature_channels=(8, 6)).eval()
    features, want = sampler.features(points)[0], torch.zeros(20)
    for i, away in enumerate(torch.cdist(points[0], points[0])):
        near = away.argsort()[: 4 if variant == "local" else 20]
        keys = sampler.keys(features[near] - features[i])
        weights = (keys @ sampler.queries(features[i]) / 8).softmax(0)
        want[i if variant == "local" else near] += weights.std() if variant == "local" else weights
    torch.testing.assert_close(sampler.attention(points)[0][0], want)
