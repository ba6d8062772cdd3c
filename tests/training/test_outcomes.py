"""What a training must end in, through the real path: each test fails with one known fault."""

import signal
from typing import Any

import pytest
import torch
from torch import nn

from mops_lightning import FPSSampler
from mops_lightning.data.clouds import Clouds
from mops_lightning.data.corruptions import corrupt
from mops_lightning.data.loader import Augmentation
from mops_lightning.nets.hierarchical import HierarchicalNet
from mops_lightning.samplers.base import Sampler
from mops_lightning.tasks.segmentation import Segmentation
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.recipe.distillation import Distillation, Targets
from mops_lightning.training.recipe.recipe import Recipe
from mops_lightning.types import Batch
from mops_lightning.zoo import weights
from tests.support.command_line import TINY, job, unbroken_and_resumed


def note_at_each_step(monkeypatch, what):
    """Collect what a function of the experiment returns in each step, before its update."""
    noted = []

    def note(experiment, _):
        noted.append(what(experiment))

    monkeypatch.setattr(Experiment, "on_before_zero_grad", note)
    return noted


def test_samplers_inside_a_net_end_their_training_at_the_tested_temperature(tmp_path, monkeypatch):
    settings = [
        "learn=task",
        "task/net=hierarchical",
        "sampler@task.net.sampler=mops",
        "task.net.points=[16,8]",
        "task.net.channels=[8,8,8]",
        "task.net.k=4",
        "trainer.max_epochs=2",
    ]

    def temperatures(experiment):
        samplers = [part for part in experiment.task.modules() if isinstance(part, Sampler)]
        return [sampler.tau for sampler in samplers]

    taus = note_at_each_step(monkeypatch, temperatures)

    job(tmp_path / "run", *settings)

    assert len(taus) == 4
    assert taus[0] == [1.0, 1.0]
    assert taus[-1] == pytest.approx([0.1, 0.1])


@pytest.mark.parametrize("optimizer", ["muon", "one_cycle"])
def test_state_of_the_optimizer_survives_a_stop(optimizer, tmp_path, monkeypatch):
    arguments = [
        *TINY,
        "weights=null",
        "baselines={}",
        f"optimizer={optimizer}",
        "trainer.max_epochs=3",
    ]

    def stop_in_fourth_step(self, _):
        if self.global_step == 3:
            signal.raise_signal(signal.SIGTERM)

    hook = "on_before_zero_grad"
    unbroken_and_resumed(arguments, tmp_path, monkeypatch, hook, stop_in_fourth_step)

    unbroken = weights.read(tmp_path / "unbroken" / weights.FILE)
    resumed = weights.read(tmp_path / "resumed" / weights.FILE)
    assert unbroken["sha256"] == resumed["sha256"]


def test_moving_average_covers_the_statistics_of_batchnorm(tmp_path, monkeypatch):
    def statistics(experiment):
        running = {}
        for name, value in experiment.sampler.named_buffers():
            if "running" in name:
                running[name] = value.clone()
        return running

    seen = note_at_each_step(monkeypatch, statistics)

    job(tmp_path / "run", "weights=null", "trainer.max_epochs=3", "recipe.ema_span=0.5")

    keep = 1 - 1 / 3  # half of six steps
    saved = weights.read(tmp_path / "run" / weights.FILE)["state"]
    assert len(seen[0]) > 4
    for name, average in seen[0].items():
        for later in seen[1:]:
            average = keep * average + (1 - keep) * later[name]
        torch.testing.assert_close(saved[name], average)
        assert not torch.equal(saved[name], seen[-1][name])


@pytest.mark.parametrize("kind", ["jitter", "rotation", "scaling", "shear", "distortion"])
def test_every_cloud_is_corrupted_by_a_draw_of_its_own(kind, rng):
    cloud = torch.randn(50, 3, generator=rng)
    alike = Clouds(cloud.expand(3, -1, -1).clone(), torch.arange(3))

    first, second, third = corrupt(alike, f"{kind}-5").points

    assert not torch.allclose(first, second, atol=1e-3)
    assert not torch.allclose(second, third, atol=1e-3)


def test_scaling_shrinks_axes_as_well_as_it_stretches_them():
    """From 1/2 to 2: two axes differ by up to 4. Only outwards, they would by at most 2."""
    ends = torch.cat([torch.eye(3), -torch.eye(3)])
    clouds = Clouds(ends.expand(200, -1, -1).clone(), torch.zeros(200, dtype=torch.int64))

    extents = corrupt(clouds, "scaling-5").points.amax(1)

    ratios = extents.amax(1) / extents.amin(1)
    assert 2.5 < float(ratios.max()) <= 4


def test_stretch_of_the_augmentation_goes_both_ways(rng):
    augment = Augmentation(stretch=1.5)

    factors = augment(torch.ones(500, 1, 3), rng)

    assert 1 / 1.5 <= float(factors.min()) < 0.7
    assert 1.45 < float(factors.max()) <= 1.5


class Shifted(nn.Module):
    """A net whose features of a point are its coordinates, moved by a number of its own."""

    def __init__(self, shift):
        super().__init__()
        self.shift = shift

    def point_features(self, points):
        return points + self.shift

    def forward(self, points):
        return points.mean(1)


def test_features_are_compared_with_those_of_the_same_net(rng):
    shifts = (0.0, 5.0)
    tasks = [Segmentation(Shifted(shift), num_parts=2) for shift in shifts]
    distillation = Distillation(tasks, Recipe(feature_distillation=2.0))
    cloud = torch.rand(4, 30, 3, generator=rng)
    sample = torch.rand(4, 8, 3, generator=rng)
    targets = Targets(None, cloud)

    for number, shift in enumerate(shifts):
        losses = distillation.losses(number, sample, None, targets)

        own = sample.amax(1) + shift
        reference = cloud.amax(1) + shift
        squares = (own - reference).square().sum(1)
        relative = float((squares / reference.square().sum(1)).mean())
        assert float(losses["feature_distillation"]) == pytest.approx(2 * relative, rel=1e-5)


def test_number_of_neighbours_of_segmentation_changes_its_result(tmp_path):
    settings = [
        "task=segmentation",
        "task.net.points=[16,8]",
        "sampler=fps",
        "weights=null",
        "dataset.classes=[lamp]",
    ]

    one = job(tmp_path / "1", *settings, "task.k=1")
    three = job(tmp_path / "3", *settings, "task.k=3")

    assert one.config["task"]["k"] == 1
    assert three.config["task"]["k"] == 3
    loss = "test/loss/cross_entropy"
    assert one.metrics[loss] != three.metrics[loss]


def test_one_neighbour_gives_a_point_the_part_of_its_nearest_sample(rng):
    cloud = torch.rand(2, 40, 3, generator=rng)
    sample = cloud[:, :8]

    class Net(nn.Module):
        def forward(self, points):
            return points[..., :2]

    task = Segmentation(Net(), num_parts=2, k=1)
    parts = torch.zeros(2, 40, dtype=torch.int64)

    predicted = task.predict(Batch(cloud, torch.zeros(2), None, parts), sample)

    nearest = torch.cdist(cloud, sample).argmin(2)
    for number in range(2):
        expected = sample[number, nearest[number], :2]
        torch.testing.assert_close(predicted[number], expected)


def test_head_of_a_hierarchical_net_reads_maxima_of_all_stages_and_the_mean_of_the_last(rng):
    torch.manual_seed(0)
    net: Any = HierarchicalNet(
        3, lambda m: FPSSampler(m), [16, 8], [6, 7, 9], k=4, hidden=10
    ).eval()
    points = torch.rand(5, 40, 3, generator=rng)
    (_, first), (_, last) = net.levels(points)[1:]

    logits = net(points)

    pooled = torch.cat([first.amax(1), last.amax(1), last.mean(1)], 1)
    torch.testing.assert_close(logits, net.head(pooled))
    with torch.no_grad():
        net.head[0].weight[:, : 7 + 9] = 0  # nothing but the mean is left
        spread = float(net(points).std(0).sum())
    assert spread > 1e-6
