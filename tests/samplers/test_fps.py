import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.ops.fps import farthest_point_sample
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.samplers.ordering import seeded_order
from tests.support.plain import plain_farthest


def test_fps_sampler_equals_double_loop(rng):
    points = torch.randn(3, 50, 3, generator=rng)
    chosen = FPSSampler(12, seed=5)(points).indices
    first = seeded_order(points, 5)[:, 0]
    for b in range(3):
        assert chosen[b].tolist() == plain_farthest(points[b], [int(first[b])], 12)


def test_fps_sampler_uses_start(rng):
    points = torch.randn(3, 50, 3, generator=rng)
    chosen = FPSSampler(12, start=49)(points).indices
    assert torch.equal(chosen, farthest_point_sample(points, 12, start=49))
    with pytest.raises(UserError, match=r"^start must be less than .* N=9, got 9"):
        FPSSampler(4, start=9)(torch.zeros(1, 9, 3))


def test_fps_sampler_with_weights_starts_at_the_heaviest_point(rng):
    points = torch.randn(20, 50, 3, generator=rng)
    weight = torch.rand(20, 50, generator=rng)

    chosen = FPSSampler(3).sample_weighted(points, 3, weight)
    from_row = FPSSampler(3, start=7).sample_weighted(points, 3, weight)

    assert torch.equal(chosen[:, 0], weight.argmax(1))
    assert from_row[:, 0].tolist() == [7] * 20


def test_fps_sampler_farthest_start_moves_with_the_cloud(rng):
    points = torch.randn(3, 50, 3, generator=rng)
    sampler = FPSSampler(12, start="farthest")
    chosen = sampler(points).indices
    first = (points - points.mean(1, keepdim=True)).norm(dim=2).argmax(1)
    for b in range(3):
        assert chosen[b].tolist() == plain_farthest(points[b], [int(first[b])], 12)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=rng)).Q
    order = torch.randperm(50, generator=rng)
    assert torch.equal(order[sampler(points[:, order] @ turn + 1).indices], chosen)
