import pytest
import torch

from mops_lightning.data.clouds import Clouds
from mops_lightning.data.noise import noisy, noisy_clouds
from mops_lightning.types import TruePairs


def test_noisy_has_standard_deviation(rng):
    points = torch.randn(20, 2000, 3, generator=rng)
    added = noisy(points, 0.05) - points
    assert added.std((0, 1)).tolist() == pytest.approx([0.05] * 3, rel=0.02)
    assert added.mean((0, 1)).abs().max() < 0.001
    assert added.abs().max() > 0.2  # not clipped at four standard deviations


def test_noisy_depends_on_position_and_scales(rng):
    points = torch.randn(5, 30, 3, generator=rng)
    torch.testing.assert_close(noisy(points, 0.1)[:3], noisy(points[:3], 0.1))
    small, large = noisy(points, 0.01) - points, noisy(points, 0.1) - points
    torch.testing.assert_close(10 * small, large, atol=1e-5, rtol=1e-4)
    assert not torch.equal(small[0], small[1])
    assert torch.equal(noisy(points, 0.0), points)


def test_noisy_clouds_of_pairs_differ(rng):
    points, rest = torch.randn(4, 30, 3, generator=rng), torch.ones(4)
    clouds = Clouds(points, rest, pairs=TruePairs(points, rest, rest, rest, rest))
    added = noisy_clouds(clouds, 0.1)
    torch.testing.assert_close(added.points, noisy(points, 0.1))
    assert added.pairs is not None
    assert (added.pairs.target - points).std() > 0.08
    assert not torch.allclose(added.pairs.target, added.points, atol=0.05)


def test_noisy_leaves_attributes(rng):
    points = torch.randn(5, 30, 4, generator=rng)
    added = noisy(points, 0.1)
    assert torch.equal(added[..., 3], points[..., 3])
    assert torch.equal(added[..., :3], noisy(points[..., :3], 0.1))
