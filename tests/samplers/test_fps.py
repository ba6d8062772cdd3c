import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.ops import compiled, farthest
from mops_lightning.ops.fps import farthest_point_sample
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.samplers.ordering import point_hashes, seeded_order
from tests.support.plain import plain_farthest


def plain_rows(points, first_rows, m):
    """The rows of every cloud that a double loop chooses after the first one."""
    rows = []
    for cloud, first in zip(points, first_rows, strict=True):
        rows.append(plain_farthest(cloud, [first], m))
    return rows


def test_fps_sampler_equals_double_loop(randn):
    points = randn(3, 50, 3)

    indices = FPSSampler(12, seed=5)(points).indices

    first_rows = seeded_order(points, 5)[:, 0]
    assert indices.tolist() == plain_rows(points, first_rows.tolist(), 12)


def plain_rows_among_copies(cloud, hashes, m):
    """The point farthest from the chosen ones; the lowest hash, then row wins a tie."""
    rows = [min(range(len(cloud)), key=lambda row: (hashes[row], row))]
    while len(rows) < m:
        distances = (cloud[:, None] - cloud[rows]).square().sum(2).amin(1).tolist()
        left = set(range(len(cloud))) - set(rows)
        rows.append(min(left, key=lambda row: (-distances[row], hashes[row], row)))
    return rows


@pytest.mark.parametrize("start", [None, "farthest"])
def test_fps_sampler_orders_ties_and_copies_by_hash_then_row_on_every_device(
    start, rng, monkeypatch
):
    points = torch.randint(0, 3, (4, 60, 3), generator=rng).float()  # at most 27 different points

    rows = FPSSampler(60, seed=3, start=start)(points).indices

    with monkeypatch.context() as patch:
        patch.setattr(compiled, "farthest_from_start", lambda *_: None)
        patch.setattr(compiled, "farthest", lambda *_: None)
        rows_in_torch = FPSSampler(60, seed=3, start=start)(points).indices
    assert torch.equal(rows_in_torch, rows)
    if start is None:
        hashes = point_hashes(points, 3).tolist()
        for cloud, hashes_of_cloud, chosen in zip(points, hashes, rows.tolist(), strict=True):
            assert chosen == plain_rows_among_copies(cloud, hashes_of_cloud, 60)


def test_fps_sampler_uses_start(randn):
    points = randn(3, 50, 3)

    indices = FPSSampler(12, start=49)(points).indices

    expected = farthest_point_sample(points, 12, start=49)
    assert torch.equal(indices, expected)


def test_fps_sampler_start_beyond_the_points_is_refused():
    points = torch.zeros(1, 9, 3)

    with pytest.raises(UserError, match=r"^start must be less than .* N=9, got 9"):
        FPSSampler(4, start=9)(points)


def test_fps_sampler_with_weights_starts_at_the_heaviest_point(randn, rand):
    points = randn(20, 50, 3)
    weight = rand(20, 50)
    sampler = FPSSampler(3)
    from_row_7 = FPSSampler(3, start=7)

    rows = sampler.sample_weighted(points, 3, weight)
    rows_from_7 = from_row_7.sample_weighted(points, 3, weight)

    assert torch.equal(rows[:, 0], weight.argmax(1))
    assert (rows_from_7[:, 0] == 7).all()


def test_fps_sampler_farthest_start_equals_plain_form(randn):
    points = randn(3, 50, 3)

    indices = FPSSampler(12, start="farthest")(points).indices

    centred = points - points.mean(1, keepdim=True)
    first = centred.norm(dim=2).argmax(1)
    assert indices.tolist() == plain_rows(points, first.tolist(), 12)


def test_fps_sampler_farthest_start_moves_with_the_cloud(rng, randn):
    points = randn(3, 50, 3)
    rotation, _ = torch.linalg.qr(randn(3, 3))
    order = torch.randperm(50, generator=rng)
    moved = points[:, order] @ rotation + 1
    sampler = FPSSampler(12, start="farthest")

    indices = sampler(points).indices
    indices_of_moved = sampler(moved).indices

    assert torch.equal(order[indices_of_moved], indices)


def test_fps_sampler_with_weights_chooses_alike_on_every_device(rng, rand, monkeypatch):
    points = torch.randint(0, 4, (3, 60, 3), generator=rng).float()  # ties and copies
    weight = rand(3, 60) + 0.1
    weight[:, ::2] = 1.0
    sampler = FPSSampler(40, seed=3)

    rows = sampler.sample_weighted(points, 40, weight)

    monkeypatch.setattr(compiled, "farthest_from_start", lambda *_: None)
    monkeypatch.setattr(compiled, "farthest", lambda *_: None)
    assert torch.equal(sampler.sample_weighted(points, 40, weight), rows)


def test_fps_sampler_in_threads_chooses_the_same_rows(rand, monkeypatch):
    points = rand(5, 200, 3)
    sampler = FPSSampler(30, seed=3)
    rows = sampler(points).indices

    monkeypatch.setattr(farthest, "THREADS_MIN_WORK", 1)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)

    assert torch.equal(sampler(points).indices, rows)
