import torch

from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.samplers.critical import CriticalSampler


@torch.no_grad()
def test_critical_equals_plain_ranking(rng):
    torch.manual_seed(0)
    net = PointNetVanilla(3).eval()
    points = torch.randn(3, 60, 3, generator=rng)
    rows = CriticalSampler(20, net)(points).indices
    for cloud, chosen in zip(net.point_features(points), rows.tolist(), strict=True):
        contribution = [0.0] * 60
        for channel in cloud.T:
            contribution[int(channel.argmax())] += float(channel.max())
        number = min(20, sum(value > 0 for value in contribution))
        want = sorted(range(60), key=lambda row: -contribution[row])
        assert chosen[:number] == want[:number]


def test_critical_fills_up_by_farthest_points():
    class FirstAxis(torch.nn.Module):
        def point_features(self, points):
            return points[..., :1].relu()

    line = torch.tensor([[[1.0, 0, 0], [2, 0, 0], [3, 0, 0], [-9, 0, 0]]])
    assert CriticalSampler(3, FirstAxis())(line).indices.tolist() == [[2, 3, 0]]
