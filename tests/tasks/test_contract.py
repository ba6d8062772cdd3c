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
from mops_lightning.nets.plane_icp import PlaneICP
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.tasks.classification import Classification
from mops_lightning.tasks.reconstruction import Reconstruction
from mops_lightning.tasks.registration import Registration
from mops_lightning.tasks.scan_registration import ScanRegistration
from mops_lightning.tasks.segmentation import Segmentation
from mops_lightning.training.experiment import Experiment
from mops_lightning.types import Batch
from tests.support.samplers import SAMPLERS
from tests.support.training import changed, quiet_trainer, small_dataset, state

POINTS = 72
LARGEST = 64


def small_segmentation() -> Segmentation:
    net = HierarchicalSegmentation(2, FPSSampler, points=(20, 8), channels=(8, 16, 16), k=4)
    return Segmentation(net, 2)


TASKS = {
    "classification": lambda: Classification(PointNetVanilla(3), 3),
    "reconstruction": lambda: Reconstruction(AutoEncoder(POINTS, 8)),
    "reconstruction_folding": lambda: Reconstruction(MFoldingNet(POINTS, 2, 8)),
    "registration": lambda: Registration(PCRNet(feature_channels=(8, 16))),
    "segmentation": small_segmentation,
}
# Sizes on both sides of 32 points, where the pooling layer changes its algorithm, in one step.
LEARNED = ("mops", "fmops", "snet", "samplenet", "samplenet-progressive")


MEASURED = {
    "classification": ["accuracy", "mean_class_accuracy"],
    "reconstruction": [
        "chamfer",
        "emd",
        "nre_cd",
        "nre_cd_of_means",
        "nre_emd",
        "nre_emd_of_means",
    ],
    "registration": [
        "rotation_error_deg",
        "rotation_error_doubled_deg",
        "rotation_error_p90_deg",
        "rotation_recall_10deg",
        "rotation_recall_5deg",
        "translation_error",
    ],
    "segmentation": ["mean_iou", "point_accuracy"],
    "icp": [
        "median_rotation_error_deg",
        "rotation_error_deg",
        "rotation_recall_2deg",
        "translation_error",
    ],
}
"""The names of the metrics of each task."""

SCORES = {
    "classification": ("accuracy", None),
    "reconstruction": ("nre_cd", "chamfer"),
    "registration": ("rotation_error_deg", None),
    "segmentation": ("mean_iou", None),
    "icp": ("median_rotation_error_deg", None),
}
"""Of each task, the score of samples, and that of full clouds where it is another one."""


@pytest.mark.parametrize("name", MEASURED)
def test_task_measures_these_metrics_and_has_this_score(name):
    make: Any = TASKS.get(name, lambda: ScanRegistration(PlaneICP()))

    task = make()

    assert sorted(task.metrics()) == MEASURED[name]
    assert (task.score, task.full_score) == SCORES[name]


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
    parts = set()
    for name in changed(before, module):
        part, _, _ = name.partition(".")
        parts.add(part)
    return parts


LEARNS: dict[tuple[str, str], set[str]] = {}
for learned in LEARNED:
    LEARNS[learned, "sampler"] = {"sampler"}
for learned in LEARNED:
    LEARNS[learned, "joint"] = {"sampler", "task"}
LEARNS["fps", "joint"] = {"task"}


@pytest.mark.parametrize(("sampler", "learn"), LEARNS)
@pytest.mark.parametrize("task", TASKS)
def test_task_step_with_any_sampler_changes_what_learns(task, sampler, learn):
    parts = trained_parts(task, sampler, learn)

    assert parts == LEARNS[sampler, learn]


@pytest.mark.parametrize("task", TASKS)
def test_task_step_without_sampler_changes_task(task):
    parts = trained_parts(task, None, "task")

    assert parts == {"task"}


@pytest.mark.parametrize("task", TASKS)
def test_disagreement_is_zero_only_for_equal_predictions(task: str) -> None:
    module = TASKS[task]().eval()
    data = small_dataset(4, points=POINTS)
    loader = CloudLoader(data.test, 4, make_batch=module.make_batch)
    batch = next(iter(loader))
    elsewhere = 9 - batch.points[:, :8]
    reference = module.predict(batch, batch.points)
    prediction = module.predict(batch, elsewhere)

    same = module.disagreement(reference, reference)
    other = module.disagreement(prediction, reference)

    assert same.shape == (4,)
    assert other.shape == (4,)
    assert same.abs().max() < 1e-6
    assert other.min() > 1e-6
    other.sum().backward()
    assert has_gradient(module)


def has_gradient(module: torch.nn.Module) -> bool:
    """Return whether the loss depends on any weight."""
    return any(weights.grad is not None and weights.grad.any() for weights in module.parameters())


def test_disagreement_is_divergence_of_reference_from_prediction():
    """Kullback-Leibler divergences are not symmetric."""
    task = Classification(PointNetVanilla(2), 2)
    reference = torch.tensor([[0.9, 0.1]])
    found = torch.tensor([[0.5, 0.5]])
    logits_of_reference = reference.log() + 3  # up to a constant

    apart = task.disagreement(found.log(), logits_of_reference)

    expected = 0.9 * math.log(0.9 / 0.5) + 0.1 * math.log(0.1 / 0.5)
    assert apart.tolist() == pytest.approx([expected])


def test_smoothed_labels_give_every_class_a_share(randn):
    task = Classification(PointNetVanilla(4), 4, label_smoothing=0.2).eval()
    points = randn(3, 9, 3)
    labels = torch.tensor([0, 2, 3])
    batch = Batch(points, labels)

    loss = task.step(batch, points).losses["cross_entropy"]

    one_hot = torch.eye(4)[labels]
    targets = 0.8 * one_hot + 0.2 / 4
    log_shares = task.predict(batch, points).log_softmax(1)
    expected = -(targets * log_shares).sum(1).mean()
    assert_close(loss, expected)


@pytest.mark.parametrize("share", [1.0, -0.1])
def test_label_smoothing_out_of_range_is_refused(share):
    with pytest.raises(UserError, match=rf"label_smoothing must be in \[0, 1\), got {share}"):
        Classification(PointNetVanilla(4), 4, label_smoothing=share)


def test_net_that_is_no_module_is_refused():
    no_net: Any = len

    with pytest.raises(UserError, match=r"net must be a torch\.nn\.Module, got <built-in"):
        Classification(no_net, 4)


def test_net_of_another_task_is_refused():
    net = PointNetVanilla(4)

    with pytest.raises(UserError) as refused:
        Registration(net)

    assert str(refused.value) == (
        "net must take (source, target), as registration needs it; got PointNetVanilla, which "
        "takes (points). Choose a net of this task."
    )
