"""Train a sampler for a network and a loss of your own, in a plain loop.

    python examples/03_own_network.py 200

The network tells boxes that are short in x from boxes that are short in y. A tenth of the points
are outliers. Farthest points take outliers first; the sampler learns to leave them out.
"""

import sys

import torch
from torch import nn
from torch.nn.functional import cross_entropy

from mops_lightning import FPSSampler, MOPSNet

steps = int(sys.argv[1])
torch.manual_seed(0)


def boxes(count):
    labels = torch.randint(2, (count,))
    sides = torch.ones(count, 1, 3)
    sides[torch.arange(count), 0, labels] = 0.6
    points = (torch.rand(count, 128, 3) - 0.5) * sides
    points[:, :12] = 1.5 * (torch.rand(count, 12, 3) - 0.5)  # the outliers
    return points, labels


class Net(nn.Sequential):
    def forward(self, points):
        return super().forward(points).mean(dim=1)  # what its layers say of a point, averaged


def train(module, lr, loss_of):
    optimizer = torch.optim.Adam(module.parameters(), lr=lr)
    for step in range(steps):
        optimizer.zero_grad()
        loss_of(step, *boxes(32)).backward()
        optimizer.step()


def loss_of_sampler(step, points, labels):
    sampler.anneal(step / steps)  # lowers the temperature of S
    sample = sampler(points)  # sample.points: (32, 16, 3)
    return cross_entropy(net(sample.points), labels) + sum(sample.losses.values())


net = Net(nn.Linear(3, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, 2))
train(net, 1e-2, lambda step, points, labels: cross_entropy(net(points), labels))
net.eval().requires_grad_(False)
sampler = MOPSNet(m=16)
train(sampler, 2e-3, loss_of_sampler)

points, labels = boxes(200)
for name, method in (("MOPS-Net", sampler.eval()), ("farthest points", FPSSampler(16))):
    few, _ = method.downsample(points, 16)  # 16 different points of each cloud
    share = (net(few).argmax(dim=1) == labels).float().mean()
    print(f"{name}: {share:.1%} of the boxes right from 16 of 128 points")
