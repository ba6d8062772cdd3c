"""Write a sampler of your own, and train it beside farthest points for a task net, with Lightning.

    python examples/04_own_sampler.py --epochs 10

The command line takes the same class: python -m mops_lightning sampler._target_=my_module.MySampler
"""

import argparse
from functools import partial

import lightning as L
import torch
from torch import nn

from mops_lightning import FPSSampler, SampleOutput, Sampler, chamfer_distance
from mops_lightning.data.loader import CloudLoader
from mops_lightning.data.shapes import shapes
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.tasks.classification import Classification
from mops_lightning.training.experiment import Experiment

parser = argparse.ArgumentParser()
parser.add_argument("--epochs", type=int, default=10)
epochs = parser.parse_args().epochs


class MySampler(Sampler):
    """Every sampled point is an average of all points, weighted by a small net."""

    generates = True

    def __init__(self, m, width=32, weight=1.0):
        super().__init__(m)
        self.weight = weight
        self.net = nn.Sequential(nn.Linear(3, width), nn.ReLU(), nn.Linear(width, m))

    def sample(self, points, m):
        shares = self.net(points).softmax(dim=1)  # (B, N, m)
        return SampleOutput(shares.transpose(1, 2) @ points, None, {})

    def losses(self, points, output, sizes):
        loss = chamfer_distance(points, output.points).mean()
        return {size: {"chamfer": self.weight * loss} for size in sizes}


L.seed_everything(0)
dataset = shapes(n_points=256, train_per_class=20, test_per_class=10, seed=0)
classes = len(dataset.class_names)
experiment = Experiment(
    Classification(PointNetVanilla(classes), classes),
    MySampler(m=16),
    make_optimizer=partial(torch.optim.Adam, lr=1e-3),
    learn="joint",  # the task net is trained with the sampler
    baselines={"fps": FPSSampler(16)},
)
trainer = L.Trainer(max_epochs=epochs, accelerator="cpu", enable_checkpointing=False)
trainer.fit(experiment, CloudLoader(dataset.train, 32, shuffle=True, drop_last=True))
(scores,) = trainer.test(experiment, CloudLoader(dataset.test, 32), verbose=False)
for name in ("generated", "completed", "fps"):
    print(f"{name}: {scores[f'test/{name}/accuracy']:.1%} of the shapes from 16 points")
