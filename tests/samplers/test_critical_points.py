import copy
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from mops_lightning.errors import UserError
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.critical_points import CriticalSampler
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.samplers.ordering import seeded_order
from tests.support.plain import plain_farthest


def plain_contributions(features):
    """Return the sum of the maxima of channels that each point has."""
    contributions = [0.0] * len(features)
    for channel in features.T:
        contributions[int(channel.argmax())] += float(channel.max())
    return contributions


@torch.no_grad()
def test_critical_equals_plain_ranking(randn):
    net = PointNetVanilla(3).eval()
    points = randn(3, 60, 3)

    indices = CriticalSampler(20, net)(points).indices

    features = net.point_features(points)
    for cloud, rows in enumerate(indices.tolist()):
        contributions = plain_contributions(features[cloud])
        critical = [row for row in range(60) if contributions[row] > 0]
        expected = sorted(critical, key=lambda row: -contributions[row])[:20]
        assert rows[: len(expected)] == expected


def modes_of(net):
    return [module.training for module in net.modules()]


def test_critical_leaves_net_as_it_is(randn):
    net: Any = PointNetVanilla(3)
    net.pool.eval()
    modes = modes_of(net)
    before = copy.deepcopy(net.state_dict())
    sampler = CriticalSampler(4, net)

    sampler(randn(2, 40, 3))

    assert modes_of(net) == modes
    assert_close(net.state_dict(), before, atol=0, rtol=0)


def test_critical_large_batch_equals_small_ones(randn, monkeypatch):
    sampler = CriticalSampler(6, PointNetVanilla(3))
    points = randn(5, 40, 3)
    whole = sampler(points).indices
    monkeypatch.setattr("mops_lightning.samplers.critical_points.BATCH_POINTS", 80)

    two_by_two = sampler(points).indices

    assert torch.equal(two_by_two, whole)


@pytest.mark.parametrize(
    ("net", "words"),
    [
        (None, "net must be the task net.*CriticalSampler"),
        (torch.nn.Linear(3, 3), "net must have features of single points.*got Linear"),
    ],
)
def test_critical_unsuitable_net_raises(net, words):
    with pytest.raises(UserError, match=words):
        CriticalSampler(4, net)(torch.rand(1, 9, 3))


def test_critical_by_features_equals_those_of_a_net(randn):
    net = PointNetVanilla(3).eval()
    points = randn(3, 60, 3)
    features = net.point_features(points)

    found = CriticalSampler(20).by_features(points, features, 20)

    expected = CriticalSampler(20, net)(points)
    assert torch.equal(found.points, expected.points)
    assert found.indices is not None
    assert torch.equal(gather_points(points, found.indices), found.points)


class FirstAxis(torch.nn.Module):
    """Its only channel is the first coordinate where that is positive."""

    def point_features(self, points):
        return points[..., :1].relu()


@pytest.mark.parametrize(
    ("line", "chosen"),
    [
        ([1.0, 2, 3, -9, 0.5, 1.5, 2.5, -1], [2, 3, 7]),
        ([-1.0, -2, -9, -3, -4, -5, -6, -8], None),  # no point is critical
    ],
)
def test_critical_fills_up_by_farthest_points(line, chosen):
    points = torch.zeros(1, 8, 3)
    points[0, :, 0] = torch.tensor(line)

    (rows,) = CriticalSampler(3, FirstAxis())(points).indices.tolist()

    if chosen is None:
        first = int(seeded_order(points, 0)[0, 0])
        chosen = plain_farthest(points[0], [first], 3)
    assert rows == chosen


def test_critical_ties_keep_seeded_order(randn):
    class OwnChannels(torch.nn.Module):
        def point_features(self, points):
            return torch.eye(points.shape[1]).expand(len(points), -1, -1)

    points = randn(2, 60, 3)
    net = OwnChannels()
    for seed in (0, 1):
        sampler = CriticalSampler(20, net, seed)

        rows = sampler(points).indices
        by_features = sampler.by_features(points, net.point_features(points), 20)

        expected = seeded_order(points, seed)[:, :20]
        assert torch.equal(rows, expected)
        assert torch.equal(by_features.points, gather_points(points, expected))


def test_critical_leaves_modes_of_a_failing_net_as_they_are(randn):
    net: Any = PointNetVanilla(3)
    net.pool.eval()
    modes = modes_of(net)
    sampler = CriticalSampler(4, net)
    net.point_features = None

    with pytest.raises(TypeError):
        sampler(randn(2, 40, 3))

    assert modes_of(net) == modes


def test_critical_without_any_contribution_starts_from_the_first_point_in_seeded_order(randn):
    points = randn(2, 40, 3)
    features = torch.zeros(2, 40, 4)

    chosen = CriticalSampler(5, seed=3).by_features(points, features, 5)

    expected = FPSSampler(5, seed=3)(points)
    assert chosen.indices is not None
    assert expected.indices is not None
    assert torch.equal(chosen.indices, expected.indices)
