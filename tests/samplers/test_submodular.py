import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.samplers.submodular import SubmodularSampler


@pytest.fixture
def net():
    torch.manual_seed(0)
    return PointNetVanilla(5).eval()


def share_of_coverage(net, points, rows):
    features = net.point_features(points)[0]
    return (features[rows].amax(0).sum() / features.amax(0).sum()).item()


@torch.no_grad()
def test_submodular_covers_more_than_any_single_exchange(net, rng):
    points = torch.randn(1, 40, 3, generator=rng)
    rows = SubmodularSampler(1, net)(points).indices[0].tolist()
    best = max(share_of_coverage(net, points, [row]) for row in range(40))
    assert share_of_coverage(net, points, rows) == pytest.approx(best)


@torch.no_grad()
def test_submodular_reaches_result_of_all_points(net, rng):
    points = torch.randn(2, 300, 3, generator=rng)
    output = SubmodularSampler(299, net)(points)
    torch.testing.assert_close(net(output.points), net(points))


def test_submodular_leaves_net_as_it_is(net, rng):
    net.train()
    net.pool.eval()
    before = {name: value.clone() for name, value in net.state_dict().items()}
    sampler = SubmodularSampler(4, net)
    sampler(torch.randn(2, 40, 3, generator=rng))
    assert all(torch.equal(value, before[name]) for name, value in net.state_dict().items())
    assert net.training
    assert net.features.training
    assert not net.pool.training
    assert not sampler.learned
    assert not sampler.state_dict()


def test_submodular_large_batch_equals_small_ones(net, rng, monkeypatch):
    points = torch.randn(5, 40, 3, generator=rng)
    whole = SubmodularSampler(6, net)(points).indices
    monkeypatch.setattr("mops_lightning.samplers.task_net.BATCH_POINTS", 80)
    assert torch.equal(SubmodularSampler(6, net)(points).indices, whole)


@pytest.mark.parametrize(
    ("net", "words"),
    [
        (None, "net must be the task net.*SubmodularSampler"),
        (torch.nn.Linear(3, 3), "net must have features of single points.*got Linear"),
    ],
)
def test_submodular_unsuitable_net_raises(net, words):
    with pytest.raises(UserError, match=words):
        SubmodularSampler(4, net)
