"""Every task trains with every sampler and every value of ``learn`` that exists."""

import math
from functools import partial
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from mops_lightning.data.loader import CloudLoader
from mops_lightning.errors import UserError
from mops_lightning.nets.autoencoder import AutoEncoder
from mops_lightning.nets.foldingnet import MFoldingNet
from mops_lightning.nets.hierarchical import HierarchicalSegmentation
from mops_lightning.nets.pcrnet import PCRNet
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.tasks.classification import Classification
from mops_lightning.tasks.reconstruction import Reconstruction
from mops_lightning.tasks.registration import Registration
from mops_lightning.tasks.segmentation import Segmentation
from mops_lightning.training.experiment import Experiment
from mops_lightning.types import Batch
from tests.support.samplers import SAMPLERS
from tests.support.training import changed, quiet_trainer, small_dataset, state

POINTS = 72
LARGEST = 64

TASKS = {
    "classification": lambda: Classification(PointNetVanilla(3), 3),
    "reconstruction": lambda: Reconstruction(AutoEncoder(POINTS, 8)),
    "reconstruction_folding": lambda: Reconstruction(MFoldingNet(POINTS, 2, 8)),
    "registration": lambda: Registration(PCRNet(feature_channels=(8, 16))),
    "segmentation": lambda: Segmentation(
        HierarchicalSegmentation(2, FPSSampler, (20, 8), (8, 16, 16), 4), 2
    ),
}
# Sizes on both sides of 32 points, where the pooling layer changes its algorithm, in one step.
LEARNED = ("mops", "fmops", "snet", "samplenet", "samplenet-progressive")


def trained_parts(task: str, sampler: str | None, learn: Any) -> set[str]:
    """Train one step and return which of task and sampler changed: weights or statistics."""
    torch.manual_seed(0)
    task_module = TASKS[task]()
    sampler_module = None
    if sampler is not None:
        sampler_module = SAMPLERS[sampler](LARGEST)
    make_optimizer = partial(torch.optim.Adam, lr=1e-2)
    module = Experiment(task_module, sampler_module, learn, make_optimizer)
    data = small_dataset(train=4, points=POINTS)
    loader = CloudLoader(data.train, 4, shuffle=True, make_batch=task_module.make_batch)
    before = state(module)
    quiet_trainer(1).fit(module, loader, loader)
    return {name.partition(".")[0] for name in changed(before, module)}


LEARNS = {
    **{(name, "sampler"): {"sampler"} for name in LEARNED},
    **{(name, "joint"): {"sampler", "task"} for name in LEARNED},
    ("fps", "joint"): {"task"},
}


@pytest.mark.parametrize(("sampler", "learn"), LEARNS)
@pytest.mark.parametrize("task", TASKS)
def test_task_step_with_any_sampler_changes_what_learns(task, sampler, learn):
    assert trained_parts(task, sampler, learn) == LEARNS[sampler, learn]


@pytest.mark.parametrize("task", TASKS)
def test_task_step_without_sampler_changes_task(task):
    assert trained_parts(task, None, "task") == {"task"}


@pytest.mark.parametrize("task", TASKS)
def test_disagreement_is_zero_only_for_equal_predictions(task: str) -> None:
    module = TASKS[task]().eval()
    data = small_dataset(4, points=POINTS)
    batch = next(iter(CloudLoader(data.test, 4, make_batch=module.make_batch)))
    reference = module.predict(batch, batch.points)
    prediction = module.predict(batch, 9 - batch.points[:, :8])

    same = module.disagreement(reference, reference)
    other = module.disagreement(prediction, reference)

    assert same.shape == (4,)
    assert other.shape == (4,)
    assert same.abs().max() < 1e-6
    assert other.min() > 1e-6
    other.sum().backward()
    gradients = [p.grad for p in module.parameters() if p.grad is not None]
    assert any(gradient.any() for gradient in gradients)


def test_disagreement_is_divergence_of_reference_from_prediction():
    """Kullback-Leibler divergences are not symmetric."""
    task = Classification(PointNetVanilla(2), 2)
    reference = torch.tensor([[0.9, 0.1]])
    found = torch.tensor([[0.5, 0.5]])

    apart = task.disagreement(found.log(), reference.log() + 3)  # logits, up to a constant

    expected = 0.9 * math.log(0.9 / 0.5) + 0.1 * math.log(0.1 / 0.5)
    assert_close(apart, torch.tensor([expected]))


def test_smoothed_labels_give_every_class_a_share(randn):
    task = Classification(PointNetVanilla(4), 4, label_smoothing=0.2).eval()
    points = randn(3, 9, 3)
    labels = torch.tensor([0, 2, 3])
    batch = Batch(points, labels)

    loss = task.step(batch, points).losses["cross_entropy"]

    targets = 0.8 * torch.eye(4)[labels] + 0.2 / 4
    log_shares = task.predict(batch, points).log_softmax(1)
    expected = -(targets * log_shares).sum(1).mean()
    assert_close(loss, expected)


def test_label_smoothing_of_one_is_refused():
    with pytest.raises(UserError, match=r"label_smoothing must be in \[0, 1\), got 1"):
        Classification(PointNetVanilla(4), 4, label_smoothing=1.0)
