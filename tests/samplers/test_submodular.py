import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.samplers.submodular import SHORTLIST, SubmodularSampler, facility_location


@pytest.fixture
def net():
    return PointNetVanilla(5).eval()


@torch.no_grad()
def test_submodular_reaches_result_of_all_points(net, rng):
    points = torch.randn(2, 300, 3, generator=rng)
    output = SubmodularSampler(299, net)(points)
    torch.testing.assert_close(net(output.points), net(points))


def test_submodular_leaves_net_as_it_is(net, rng):
    net.train()
    net.pool.eval()
    modes = [module.training for module in net.modules()]
    before = {name: value.clone() for name, value in net.state_dict().items()}
    sampler = SubmodularSampler(4, net)
    sampler(torch.randn(2, 40, 3, generator=rng))
    assert all(torch.equal(value, before[name]) for name, value in net.state_dict().items())
    net.point_features = None
    with pytest.raises(TypeError):
        sampler(torch.randn(2, 40, 3, generator=rng))
    assert [module.training for module in net.modules()] == modes
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


def plain_greedy(features, m):
    """One cloud: every gain in every step."""
    chosen: list[int] = []
    covered = torch.zeros(features.shape[1], dtype=features.dtype)
    while len(chosen) < m:
        gains = (features - covered).clamp(min=0).sum(1)
        gains[chosen] = -1
        best = int(gains.argmax())
        if chosen and gains[best] <= 0:
            break
        chosen.append(best)
        covered = torch.maximum(covered, features[best])
    return chosen


@pytest.mark.parametrize("points", [SHORTLIST - 3, 4 * SHORTLIST])
@pytest.mark.parametrize("channels", [3, 40])
def test_facility_location_equals_plain_greedy(points, channels, rng):
    features = torch.randn(5, points, channels, dtype=torch.float64, generator=rng).relu()
    features[1, points // 2 :] = features[1, : points - points // 2].clone()  # ties
    chosen, counts = facility_location(features, points - 1)
    for cloud, row, number in zip(features, chosen, counts, strict=True):
        want = plain_greedy(cloud, points - 1)
        assert torch.equal(cloud[row[:number]], cloud[want])
        assert len(set(row[:number].tolist())) == number
    assert counts.min() < points - 1 or channels > 3


def test_facility_location_of_one_point_or_without_gain_chooses_one():
    with torch.device("meta"):  # the default device is not used
        chosen, counts = facility_location(torch.ones(2, 1, 6, device="cpu"), 1)
    assert chosen.tolist() == [[0], [0]]
    assert counts.tolist() == [1, 1]
    chosen, counts = facility_location(torch.zeros(2, 40, 6), 5)
    assert (chosen.shape, counts.tolist()) == ((2, 5), [1, 1])
