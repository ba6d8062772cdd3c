"""Ask which method of downsampling pays for a trained net of your own, and keep the best.

    python examples/08_is_it_worth_it.py 5

The net tells boxes that are short in x from boxes that are short in y. A tenth of the points are
outliers. On the command line: python -m mops_lightning compare boxes --task-net RUN --m 8,32
"""

import sys
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.nn.functional import cross_entropy

from mops_lightning import load
from mops_lightning.files.task_net.compare import compare_task_net

random = np.random.default_rng(0)


def box(label):
    points = random.uniform(-0.5, 0.5, (1024, 3))
    points[:, label] *= 0.6
    points[:100] *= 1.5  # the outliers
    return points / np.linalg.norm(points, axis=1).max()


for label in (0, 1):
    folder = Path("boxes", f"short_in_{'xy'[label]}")
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(10):
        np.save(folder / f"{number}.npy", box(label))


class Net(nn.Sequential):
    def forward(self, points):
        return super().forward(points).mean(dim=1)  # what its layers say of a point, averaged


torch.manual_seed(0)
net = Net(nn.Linear(3, 64), nn.ReLU(), nn.Linear(64, 2))
optimizer = torch.optim.Adam(net.parameters(), lr=1e-2)
for _ in range(100):
    labels = random.integers(2, size=16)
    clouds = torch.from_numpy(np.stack([box(label) for label in labels])).float()
    optimizer.zero_grad()
    cross_entropy(net(clouds), torch.from_numpy(labels)).backward()
    optimizer.step()


def loss(output, batch):  # batch.labels: positions of the folders, batch.points: (B, N, 3)
    return cross_entropy(output, batch.labels, reduction="none")


draws = int(sys.argv[1])
result = compare_task_net("boxes", net, [8, 32], loss=loss, draws=draws, crops=1, save="best")
print(result.text)
print("At 8 points, best.safetensors has", type(load("best").sampler_for(8)).__name__)
