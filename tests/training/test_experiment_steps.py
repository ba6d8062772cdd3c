"""What a training step does: temperature, points of the task net, losses over sizes."""

import copy
from functools import partial
from typing import Any

import pytest
import torch

from mops_lightning import FMOPSNet, MOPSNet, ProgressiveSampleNet, SampleNet, match
from mops_lightning.data.loader import Augmentation, CloudLoader
from mops_lightning.metrics.base import collection
from mops_lightning.ops.nearest import k_nearest
from mops_lightning.ops.points import gather_points
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.recipe.recipe import Recipe
from mops_lightning.training.schedules import exponential
from tests.support import recording
from tests.support.losses import simplification_loss, subset_loss
from tests.support.recording import Fingerprint, RecordingTask, noting, numbered_clouds
from tests.support.training import quiet_trainer

MOPS: dict[str, Any] = {"feature_channels": (8, 6), "rho_channels": (12, 10), "alpha": 2.0}
STILL = partial(torch.optim.SGD, lr=0.0)
SNET: dict[str, Any] = {"feature_channels": (8, 6), "head_channels": (12,), "alpha": 2.0}


def fitted(sampler, epochs=1, task=None, recipe=None, augment=None, others=(), **extra):
    """Train with a rate of 0, so that all steps see the same weights, and validate each epoch."""
    data = numbered_clouds()
    task = task or RecordingTask(Fingerprint())
    module = Experiment(task, sampler, make_optimizer=STILL, recipe=recipe, other_tasks=others)
    trainer = quiet_trainer(epochs, **extra)
    train = CloudLoader(data.train, 4, shuffle=True, augment=augment, drop_last=True)
    trainer.fit(module, train, CloudLoader(data.test, 10))
    return module, {name: float(value) for name, value in trainer.callback_metrics.items()}


def test_step_uses_temperature_of_its_progress():
    sampler = noting(MOPSNet, 8, tau_min=0.2, **MOPS)
    fitted(sampler, epochs=2)
    seen = [(training, output.matrix.tau) for training, _, output in sampler.samples]
    want = [(True, 0.2 ** (step / 7)) for step in range(8)]  # 2 epochs of 4 batches
    want = [*want[:4], (False, 0.2), *want[4:], (False, 0.2)]
    assert [phase for phase, _ in seen] == [phase for phase, _ in want]
    assert [value for _, value in seen] == pytest.approx([value for _, value in want])


@pytest.mark.parametrize("kind", [SampleNet, ProgressiveSampleNet])
def test_task_net_of_samplenet_gets_projected_points_in_training_only(kind, calls):
    sampler = noting(kind, 8, k=3, **SNET)
    torch.nn.init.constant_(sampler.temperature, 0.7)
    fitted(sampler)
    trained = [output for training, _, output in sampler.samples if training]
    sizes = sampler.training_sizes()
    steps = [call for call in calls if call.training]
    assert [call.points.shape[1] for call in steps] == [m for _ in trained for m in sizes]
    for number, output in enumerate(trained):
        for call, m in zip(steps[number * len(sizes) :], sizes, strict=False):
            distances, rows = k_nearest(output.points[:, :m], call.clouds, 3)
            near = call.clouds[torch.arange(4)[:, None, None], rows]
            weights = torch.softmax(-distances / 0.7**2, 2)
            projected = (weights[..., None] * near).sum(2)
            torch.testing.assert_close(call.points, projected)
            assert (call.points - output.points[:, :m]).abs().max() > 0.1
    (scored,) = [output for training, _, output in sampler.samples if not training]
    assert scored.soft_projected is None
    generated, matched, _, projected = (call.points for call in calls if not call.training)
    assert torch.equal(generated, scored.points)
    assert not torch.equal(generated, matched)
    assert not torch.equal(projected, generated)
    assert not torch.equal(projected, matched)


PROGRESSIVE = partial(noting, ProgressiveSampleNet, 16, **SNET)


@pytest.mark.parametrize(
    ("how", "make", "name", "loss"),
    [
        ("mean", lambda **_: noting(FMOPSNet, 16, **MOPS), "subset", subset_loss),
        ("sum", PROGRESSIVE, "simplification", simplification_loss),
        ("mean", PROGRESSIVE, "simplification", simplification_loss),
    ],
    ids=["fmops", "samplenet-sum", "samplenet-mean"],
)
def test_losses_over_sizes_are_summed_or_averaged(how, make, name, loss, calls):
    sampler = make(size_reduction=how)
    module, logged = fitted(sampler, limit_train_batches=1, limit_val_batches=0)
    ((_, clouds, output),) = sampler.samples
    sizes = [call.points.shape[1] for call in calls]
    assert len(sizes) > 2
    assert sizes == sorted(set(sizes))
    share = 1 / len(sizes) if how == "mean" else 1
    with torch.no_grad():
        own = sum(2 * loss(clouds, output.points[:, :m]) for m in sizes) * share
        task = sum(module.task.net(call.points).square().mean() for call in calls) * share
    assert logged[f"train/loss/{name}"] == pytest.approx(float(own), rel=1e-4)
    assert logged["train/loss/task"] == pytest.approx(float(task), rel=1e-4)
    parts = [value for key, value in logged.items() if key.startswith("train/loss/")]
    assert 2 * logged["train/loss/total"] == pytest.approx(sum(parts), rel=1e-4)
    assert logged["train/mean_loss"] == pytest.approx(logged["train/loss/total"], rel=1e-4)
    assert logged["loss"] == pytest.approx(logged["train/loss/total"], rel=1e-4)
    assert logged.get("train/tau") == (1.0 if isinstance(sampler, FMOPSNet) else None)
    readout = "projected" if isinstance(sampler, SampleNet) else "generated"
    prints = torch.stack([module.task.net(call.points).detach() for call in calls]).mean()
    assert logged[f"train/{readout}/fingerprint"] == pytest.approx(float(prints), abs=1e-4)


def test_straight_through_losses_are_means_over_generated_and_matched_points(calls):
    recipe = Recipe(straight_through=0.0)
    one_step = {"limit_train_batches": 1, "limit_val_batches": 0}
    module, logged = fitted(noting(MOPSNet, 8, **MOPS), recipe=recipe, **one_step)
    generated, matched = (call.points for call in calls)
    clouds = calls[0].clouds
    torch.testing.assert_close(matched, gather_points(clouds, match(generated, clouds)))
    losses = [float(module.task.net(points).square().mean()) for points in (generated, matched)]
    assert logged["train/loss/task"] == pytest.approx(sum(losses) / 2, rel=1e-4)
    assert abs(losses[0] - losses[1]) > 0.1
    scored = float(module.task.net(generated).mean())
    assert logged["train/generated/fingerprint"] == pytest.approx(scored, abs=1e-4)


def test_straight_through_begins_at_its_share_of_the_training(calls):
    recipe = Recipe(straight_through=0.5)
    fitted(noting(MOPSNet, 8, **MOPS), recipe=recipe, limit_val_batches=0)
    assert len(calls) == 1 + 1 + 2 + 2  # of 4 steps


class FingerprintOfMaxima(Fingerprint):
    def point_features(self, points):
        return points.relu()


class ComparedTask(RecordingTask):
    def predict(self, batch, points):
        return self.net(points)

    def disagreement(self, found, reference):
        return (found - reference).square()

    def step(self, batch, points):
        result = super().step(batch, points)
        return result._replace(output=result.predictions)


# Predictions for clouds that do not change are computed once; with noise, for the noisy clouds.
@pytest.mark.parametrize("augment", [None, Augmentation(jitter=0.1)])
def test_distillation_targets_are_whole_clouds_and_features_of_seen_points(augment, calls):
    sampler = noting(MOPSNet, 8, **MOPS)
    module, logged = fitted(
        sampler,
        task=ComparedTask(FingerprintOfMaxima()),
        recipe=Recipe(train_points=20, distillation=3.0, feature_distillation=0.5),
        augment=augment,
        limit_train_batches=1,
        limit_val_batches=0,
    )
    ((_, seen, output),) = sampler.samples
    (call,) = calls
    assert (seen.shape[1], call.clouds.shape[1]) == (20, 40)
    assert (module.distillation.table is None) == (augment is not None)
    with torch.no_grad():
        apart = (module.task.net(output.points) - module.task.net(call.clouds)).square().mean()
        found, wanted = (points.relu().amax(1) for points in (output.points, seen))
    relative = ((found - wanted).square().sum(1) / wanted.square().sum(1)).mean()
    assert logged["train/loss/distillation"] == pytest.approx(3 * float(apart), rel=1e-4)
    assert logged["train/loss/feature_distillation"] == pytest.approx(float(relative) / 2, rel=1e-4)


def test_losses_under_several_nets_are_means_and_scores_of_the_first(calls):
    first, other = FingerprintOfMaxima(), FingerprintOfMaxima()
    torch.nn.init.constant_(other.weight, 2.5)
    recipe = Recipe(distillation=3.0, feature_distillation=0.5, straight_through=0.0)
    logged = {}
    for nets in ((first,), (other,), (first, other)):
        task, *others = map(ComparedTask, nets)
        module, logged[nets] = fitted(
            noting(MOPSNet, 8, **MOPS), task=task, others=others, recipe=recipe, epochs=2
        )
        assert not any(net.weight.requires_grad for net in nets)
        assert not any(one.training for one in module.other_tasks)
    one, two, both = logged.values()
    for name in ("task", "feature_distillation"):
        values = [found[f"train/loss/{name}"] for found in (one, two, both)]
        assert values[2] == pytest.approx((values[0] + values[1]) / 2, rel=1e-4)
    assert one["train/loss/task"] != pytest.approx(two["train/loss/task"], rel=0.1)
    own = [name for name in one if "/loss/" not in name and "loss" not in name]
    assert [both[name] for name in own] == [one[name] for name in own]


def test_nets_drawn_in_a_step_are_compared_with_predictions_of_the_first(calls):
    used = []

    class NotedTask(ComparedTask):
        def step(self, batch, points):
            result = super().step(batch, points)
            if points.requires_grad:
                used.append((self, points.detach(), batch.points))
            return result

    tasks = [NotedTask(Fingerprint()) for _ in range(4)]
    for number, task in enumerate(tasks):
        torch.nn.init.constant_(next(task.net.parameters()), 1 + number)
    recipe = Recipe(distillation=3.0, nets_per_step=2)
    _, logged = fitted(
        noting(MOPSNet, 8, **MOPS), epochs=2, task=tasks[0], others=tasks[1:], recipe=recipe
    )
    steps = [used[i : i + 3] for i in range(0, len(used), 3)]
    drawn = [[tasks.index(task) for task, *_ in step] for step in steps]
    assert len(drawn) == 8
    assert all(step[0] == 0 and len(set(step)) == 3 for step in drawn)
    assert {number for step in drawn for number in step} == {0, 1, 2, 3}
    with torch.no_grad():
        apart = [
            (task.net(points) - tasks[0].net(clouds)).square().mean()
            for task, points, clouds in steps[-1]
        ]
    assert logged["train/loss/distillation"] == pytest.approx(float(sum(apart)), rel=1e-4)


class InTests(recording.MeanFingerprint):
    """Nothing that training computes."""

    name = "in_tests"


class WithMoreInTests(RecordingTask):
    def metrics(self, training=False):
        return collection(recording.MeanFingerprint(), *([] if training else [InTests()]))


def test_training_logs_means_over_clouds_of_uneven_batches():
    module = Experiment(WithMoreInTests(Fingerprint()), None, "task", STILL)
    data, trainer = numbered_clouds(), quiet_trainer(1, limit_val_batches=0)
    trainer.fit(module, CloudLoader(data.train, 6), CloudLoader(data.test, 4))
    prints = module.task.net(data.train.points).detach()
    logged = trainer.callback_metrics
    torch.testing.assert_close(logged["train/mean_loss"], prints.square().mean())
    torch.testing.assert_close(logged["train/full/fingerprint"], prints.mean())
    assert "train/full/in_tests" not in logged
    # Of the last batch.
    torch.testing.assert_close(logged["train/loss/total"], prints[12:].square().mean())
    assert set(trainer.progress_bar_metrics) == {"loss"}
    assert "loss" not in trainer.logged_metrics


def test_random_numbers_of_a_step_depend_on_epoch_and_step(calls):
    for _ in range(2):
        fitted(noting(FMOPSNet, 16, size_sampling="uniform", **MOPS), 2, limit_val_batches=0)
    sizes = [call.points.shape[1] for call in calls]
    first, second, *again = (sizes[start : start + 4] for start in range(0, 16, 4))
    assert again == [first, second]
    assert first != second
    assert len(set(first)) > 1


def test_schedule_sets_rate_of_each_step_of_the_run():
    rates: list[float] = []

    def optimizer(parameters):
        made = torch.optim.SGD(parameters, lr=1e-3)
        made.register_step_pre_hook(lambda one, *_: rates.append(one.param_groups[0]["lr"]))
        return made

    schedule = partial(exponential, end_lr=1e-5)
    module = Experiment(RecordingTask(Fingerprint()), None, "task", optimizer, schedule)
    data = numbered_clouds()
    loaders = CloudLoader(data.train, 4, shuffle=True), CloudLoader(data.test, 4)
    quiet_trainer(2, limit_val_batches=0).fit(module, *loaders)
    # 2 epochs of 4 batches.
    assert rates == pytest.approx([1e-3 * 0.01 ** (step / 7) for step in range(8)])


@pytest.mark.parametrize("learn", ["sampler", "joint", "task"])
def test_step_follows_the_gradient_of_the_total_loss(learn, calls):
    task, sampler = RecordingTask(Fingerprint()), MOPSNet(8, **MOPS)
    before = copy.deepcopy((task, sampler))
    trained = None if learn == "task" else sampler
    module = Experiment(task, trained, learn, partial(torch.optim.SGD, lr=0.01))
    data = numbered_clouds()
    trainer = quiet_trainer(1, limit_train_batches=1, limit_val_batches=0)
    trainer.fit(module, CloudLoader(data.train, 4, shuffle=True), CloudLoader(data.test, 4))
    ((_, clouds, _, _),) = calls
    old_task, old_sampler = before
    output = old_sampler.train()(clouds)
    points = clouds if learn == "task" else output.points
    loss = old_task.net(points).square().mean()
    if learn != "task":
        loss = loss + 2 * subset_loss(clouds, points)
    loss.backward()
    for old, new, learns in (
        (old_task, task, learn != "sampler"),
        (old_sampler, sampler, learn != "task"),
    ):
        for was, now in zip(old.parameters(), new.parameters(), strict=True):
            gradient = was.grad if learns else torch.zeros_like(was)
            assert gradient is not None
            torch.testing.assert_close(now.detach(), was.detach() - 0.01 * gradient)
