"""A task that notes every set of points it is given, and clouds that can be told apart."""

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torchmetrics import MeanMetric, MetricCollection

from mops_lightning.data.clouds import CloudDataset, Clouds
from mops_lightning.metrics.base import TableMetric, collection
from mops_lightning.tasks.base import Task
from mops_lightning.types import Batch, TaskOutput

FIRST_TEST_CLOUD = 1000
"""Label of the first test cloud; training clouds are numbered from 0."""


class Call(NamedTuple):
    """What one step of the task was given.

    Attributes:
        points: ``(B, M, 3)``, the sampled points.
        clouds: ``(B, N, 3)``, the clouds that they were sampled from.
        labels: the numbers of the clouds.
        training: whether gradients were recorded.
    """

    points: Tensor
    clouds: Tensor
    labels: list[int]
    training: bool


CALLS: list[Call] = []
"""Of all recording tasks, in order; the fixture ``calls`` empties it."""


class Fingerprint(nn.Module):
    """Maps points to one number per cloud that differs with each point and with their order."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.tensor([1.0, 0.7, -0.4]))

    def forward(self, points: Tensor) -> Tensor:
        places = torch.arange(1, points.shape[1] + 1).to(points)
        return ((points @ self.weight) * (1 + places.cos())).sum(1)


class MeanFingerprint(TableMetric, MeanMetric):  # type: ignore[misc]
    name = "fingerprint"
    higher_is_better = True  # type: ignore[assignment]

    def update(self, predictions: Tensor, targets: Tensor) -> None:  # type: ignore[override]
        super().update(predictions.detach())


class RecordingTask(Task):
    """Scores points by their fingerprint, so that every set of points has a score of its own."""

    score = MeanFingerprint.name

    def step(self, batch: Batch, points: Tensor) -> TaskOutput:
        clouds = batch.points.detach().clone()
        labels = batch.labels.tolist()
        CALLS.append(Call(points.detach().clone(), clouds, labels, torch.is_grad_enabled()))
        prints = self.net(points)
        return TaskOutput({"task": prints.square().mean()}, prints, batch.labels)

    def metrics(self, training: bool = False) -> MetricCollection:
        return collection(MeanFingerprint())


def numbered_clouds(
    n_points: int = 40, train_per_class: int = 16, test_per_class: int = 10, **rest: Any
) -> CloudDataset:
    """Gaussian clouds whose labels are their numbers; takes the settings of ``dataset=shapes``."""
    rng = torch.Generator().manual_seed(5)

    def clouds(number: int, first: int) -> Clouds:
        # Multiples of 1/64: the distances are exact, and so are ties.
        points = torch.randn(number, n_points, 3, generator=rng).mul(64).round() / 64
        return Clouds(points, torch.arange(first, first + number))

    train = clouds(train_per_class, 0)
    test = clouds(test_per_class, FIRST_TEST_CLOUD)
    return CloudDataset(("numbered",), train, test, "numbered")


def noting(kind, *arguments, **settings):
    """A sampler that keeps what it returned, in ``samples``."""

    class Noting(kind):  # type: ignore[misc, valid-type]
        def sample(self, points, m):
            output = super().sample(points, m)
            self.samples.append((self.training, points.detach(), output))
            return output

    torch.manual_seed(0)
    made = Noting(*arguments, **settings)
    made.samples = []
    return made
