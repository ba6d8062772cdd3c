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
ONE_STEP: dict[str, Any] = {"limit_train_batches": 1, "limit_val_batches": 0}
SNET: dict[str, Any] = {"feature_channels": (8, 6), "head_channels": (12,), "alpha": 2.0}


def fitted(sampler, epochs=1, task=None, recipe=None, augment=None, others=(), seed=0, **extra):
    """Train with a rate of 0, so that all steps see the same weights, and validate each epoch."""
    data = numbered_clouds()
    task = task or RecordingTask(Fingerprint())
    module = Experiment(
        task, sampler, make_optimizer=STILL, recipe=recipe, other_tasks=others, seed=seed
    )
    trainer = quiet_trainer(epochs, **extra)
    train = CloudLoader(data.train, 4, shuffle=True, augment=augment, drop_last=True)
    trainer.fit(module, train, CloudLoader(data.test, 10))
    return module, metrics_of(trainer)


def metrics_of(trainer):
    return {name: float(value) for name, value in trainer.callback_metrics.items()}


def sizes_of(calls):
    return [call.points.shape[1] for call in calls]


def test_step_uses_temperature_of_its_progress():
    sampler = noting(MOPSNet, 8, tau_min=0.2, **MOPS)

    fitted(sampler, epochs=2)

    annealed = [0.2 ** (step / 7) for step in range(8)]  # 2 epochs of 4 batches
    in_training = []
    temperatures = []
    for training, _, output in sampler.samples:
        in_training.append(training)
        temperatures.append(output.matrix.tau)
    epoch = [True, True, True, True, False]
    assert in_training == [*epoch, *epoch]
    assert temperatures == pytest.approx([*annealed[:4], 0.2, *annealed[4:], 0.2])


def plain_projected(generated, clouds):
    """The projection on the 3 nearest points at a temperature of 0.7."""
    distances, rows = k_nearest(generated, clouds, 3)
    neighbours = gather_points(clouds, rows)
    logits = -distances / 0.7**2
    weights = torch.softmax(logits, 2)
    return (weights[..., None] * neighbours).sum(2)


PROGRESSIVE = partial(noting, ProgressiveSampleNet, 16, **SNET)


@pytest.mark.parametrize("kind", [SampleNet, ProgressiveSampleNet])
def test_task_net_of_samplenet_gets_projected_points_in_training(kind, calls):
    sampler = noting(kind, 8, k=3, **SNET)
    torch.nn.init.constant_(sampler.temperature, 0.7)

    fitted(sampler)

    sizes = list(sampler.training_sizes())
    steps = iter([call for call in calls if call.training])
    for training, _, output in sampler.samples:
        if not training:
            continue
        for m in sizes:
            call = next(steps)
            generated = output.points[:, :m]
            projected = plain_projected(generated, call.clouds)
            torch.testing.assert_close(call.points, projected)
            assert (call.points - generated).abs().max() > 0.1
    assert next(steps, None) is None


@pytest.mark.parametrize("kind", [SampleNet, ProgressiveSampleNet])
def test_task_net_of_samplenet_is_scored_on_generated_points(kind, calls):
    sampler = noting(kind, 8, k=3, **SNET)
    torch.nn.init.constant_(sampler.temperature, 0.7)

    fitted(sampler)

    (scored,) = [output for training, _, output in sampler.samples if not training]
    assert scored.soft_projected is None
    generated, matched, _, projected = [call.points for call in calls if not call.training]
    assert torch.equal(generated, scored.points)
    assert not torch.equal(generated, matched)
    assert not torch.equal(projected, generated)
    assert not torch.equal(projected, matched)


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

    module, logged = fitted(sampler, **ONE_STEP)

    ((_, clouds, output),) = sampler.samples
    sizes = sizes_of(calls)
    assert len(sizes) > 2
    assert sizes == sorted(set(sizes))
    own = 0.0
    task = 0.0
    prints = []
    with torch.no_grad():
        for call, m in zip(calls, sizes, strict=True):
            own += 2 * float(loss(clouds, output.points[:, :m]))
            fingerprint = module.task.net(call.points)
            task += float(fingerprint.square().mean())
            prints.append(fingerprint)
    if how == "mean":
        own /= len(sizes)
        task /= len(sizes)
    assert logged[f"train/loss/{name}"] == pytest.approx(own, rel=1e-4)
    assert logged["train/loss/task"] == pytest.approx(task, rel=1e-4)
    total = logged["train/loss/total"]
    parts = [value for key, value in logged.items() if key.startswith("train/loss/")]
    assert sum(parts) - total == pytest.approx(total, rel=1e-4)
    assert logged["train/mean_loss"] == pytest.approx(total, rel=1e-4)
    assert logged["loss"] == pytest.approx(total, rel=1e-4)
    if isinstance(sampler, FMOPSNet):
        assert logged["train/tau"] == 1.0
    else:
        assert "train/tau" not in logged
    readout = "projected" if isinstance(sampler, SampleNet) else "generated"
    mean = float(torch.stack(prints).mean())
    assert logged[f"train/{readout}/fingerprint"] == pytest.approx(mean, abs=1e-4)


def test_straight_through_losses_are_means_over_generated_and_matched_points(calls):
    recipe = Recipe(straight_through=0.0)
    sampler = noting(MOPSNet, 8, **MOPS)

    module, logged = fitted(sampler, recipe=recipe, **ONE_STEP)

    generated_call, matched_call = calls
    generated = generated_call.points
    clouds = generated_call.clouds
    matched = gather_points(clouds, match(generated, clouds))
    torch.testing.assert_close(matched_call.points, matched)
    prints = module.task.net(generated)
    of_generated = float(prints.square().mean())
    of_matched = float(module.task.net(matched).square().mean())
    mean = (of_generated + of_matched) / 2
    assert abs(of_generated - of_matched) > 0.1
    assert logged["train/loss/task"] == pytest.approx(mean, rel=1e-4)
    scored = float(prints.mean())
    assert logged["train/generated/fingerprint"] == pytest.approx(scored, abs=1e-4)


def test_step_at_several_sizes_sees_twice_the_points_of_the_largest(calls):
    sampler = noting(FMOPSNet, 16, **MOPS)

    fitted(sampler, recipe=Recipe(train_points=10), **ONE_STEP)

    ((_, seen, _),) = sampler.samples
    assert seen.shape[1] == 2 * 16
    assert min(sizes_of(calls)) < 16


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
        **ONE_STEP,
    )

    ((_, seen, output),) = sampler.samples
    (call,) = calls
    assert seen.shape[1] == 20
    assert call.clouds.shape[1] == 40
    assert (module.distillation.table is None) == (augment is not None)
    with torch.no_grad():
        predicted = module.task.net(output.points)
        target = module.task.net(call.clouds)
        features = output.points.relu().amax(1)
        reference = seen.relu().amax(1)
    apart = float((predicted - target).square().mean())
    squares = (features - reference).square().sum(1)
    reference_squares = reference.square().sum(1)
    relative = float((squares / reference_squares).mean())
    assert logged["train/loss/distillation"] == pytest.approx(3 * apart, rel=1e-4)
    assert logged["train/loss/feature_distillation"] == pytest.approx(relative / 2, rel=1e-4)


def test_losses_under_several_nets_are_means_and_scores_of_the_first(calls):
    first = FingerprintOfMaxima()
    other = FingerprintOfMaxima()
    torch.nn.init.constant_(other.weight, 2.5)

    of_first = logged_under(first)
    of_other = logged_under(other)
    of_both = logged_under(first, other)

    for key in ("train/loss/task", "train/loss/feature_distillation"):
        mean = (of_first[key] + of_other[key]) / 2
        assert of_both[key] == pytest.approx(mean, rel=1e-4)
    assert of_first["train/loss/task"] != pytest.approx(of_other["train/loss/task"], rel=0.1)
    for name, score in of_first.items():
        if "loss" not in name:
            assert of_both[name] == score


def logged_under(*nets):
    """The metrics of a training under several frozen nets."""
    recipe = Recipe(distillation=3.0, feature_distillation=0.5, straight_through=0.0)
    task, *others = [ComparedTask(net) for net in nets]
    sampler = noting(MOPSNet, 8, **MOPS)
    module, logged = fitted(sampler, task=task, others=others, recipe=recipe, epochs=2)
    for net in nets:
        assert not net.weight.requires_grad
    for other in module.other_tasks:
        assert not other.training
    return logged


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
    first, *others = tasks
    recipe = Recipe(distillation=3.0, nets_per_step=2)
    sampler = noting(MOPSNet, 8, **MOPS)

    _, logged = fitted(sampler, epochs=2, task=first, others=others, recipe=recipe)

    numbers = [tasks.index(task) for task, _, _ in used]
    assert len(numbers) == 8 * 3
    assert numbers[::3] == [0] * 8
    for drawn, also_drawn in zip(numbers[1::3], numbers[2::3], strict=True):
        assert drawn != 0
        assert also_drawn != 0
        assert drawn != also_drawn
    assert set(numbers) == {0, 1, 2, 3}
    apart = 0.0
    with torch.no_grad():
        for task, points, clouds in used[-3:]:
            difference = task.net(points) - first.net(clouds)
            apart += float(difference.square().mean())
    assert logged["train/loss/distillation"] == pytest.approx(apart, rel=1e-4)


class InTests(recording.MeanFingerprint):
    """Nothing that training computes."""

    name = "in_tests"


class WithMoreInTests(RecordingTask):
    def metrics(self, training=False):
        if training:
            return collection(recording.MeanFingerprint())
        return collection(recording.MeanFingerprint(), InTests())


def test_training_logs_means_over_clouds_of_uneven_batches():
    module = Experiment(WithMoreInTests(Fingerprint()), None, "task", STILL)
    data = numbered_clouds()
    train = CloudLoader(data.train, 6)
    val = CloudLoader(data.test, 4)
    trainer = quiet_trainer(1, limit_val_batches=0)

    trainer.fit(module, train, val)

    prints = module.task.net(data.train.points).detach()
    loss_of_last_batch = prints[12:].square().mean()
    logged = trainer.callback_metrics
    torch.testing.assert_close(logged["train/mean_loss"], prints.square().mean())
    torch.testing.assert_close(logged["train/full/fingerprint"], prints.mean())
    torch.testing.assert_close(logged["train/loss/total"], loss_of_last_batch)
    assert "train/full/in_tests" not in logged
    assert set(trainer.progress_bar_metrics) == {"loss"}
    assert "loss" not in trainer.logged_metrics


def test_random_numbers_of_a_step_depend_on_epoch_and_step(calls):
    for _ in range(2):
        sampler = noting(FMOPSNet, 16, size_sampling="uniform", **MOPS)
        fitted(sampler, epochs=2, limit_val_batches=0)

    sizes = sizes_of(calls)
    first_epoch = sizes[:4]
    second_epoch = sizes[4:8]
    assert sizes[8:] == first_epoch + second_epoch
    assert first_epoch != second_epoch
    assert len(set(first_epoch)) > 1


def test_random_numbers_of_a_step_depend_on_the_seed(calls):
    for seed in (1, 2):
        sampler = noting(FMOPSNet, 16, size_sampling="uniform", **MOPS)
        fitted(sampler, seed=seed, limit_val_batches=0)

    sizes = sizes_of(calls)
    assert len(sizes) == 8
    assert sizes[:4] != sizes[4:]


def test_schedule_sets_rate_of_each_step_of_the_run():
    rates: list[float] = []

    def optimizer(parameters):
        made = torch.optim.SGD(parameters, lr=1e-3)
        made.register_step_pre_hook(note_rate)
        return made

    def note_rate(made, *_):
        rates.append(made.param_groups[0]["lr"])

    schedule = partial(exponential, end_lr=1e-5)
    module = Experiment(RecordingTask(Fingerprint()), None, "task", optimizer, schedule)
    data = numbered_clouds()
    train = CloudLoader(data.train, 4, shuffle=True)

    quiet_trainer(2, limit_val_batches=0).fit(module, train, CloudLoader(data.test, 4))

    wanted = [1e-3 * 0.01 ** (step / 7) for step in range(8)]  # 2 epochs of 4 batches
    assert rates == pytest.approx(wanted)


@pytest.mark.parametrize("learn", ["sampler", "joint", "task"])
def test_step_follows_the_gradient_of_the_total_loss(learn, calls):
    task = RecordingTask(Fingerprint())
    sampler = MOPSNet(8, **MOPS)
    old_task = copy.deepcopy(task)
    old_sampler = copy.deepcopy(sampler)
    trained = None if learn == "task" else sampler
    module = Experiment(task, trained, learn, partial(torch.optim.SGD, lr=0.01))
    data = numbered_clouds()
    train = CloudLoader(data.train, 4, shuffle=True)
    val = CloudLoader(data.test, 4)

    quiet_trainer(1, **ONE_STEP).fit(module, train, val)

    (call,) = calls
    if learn == "task":
        loss = old_task.net(call.clouds).square().mean()
    else:
        points = old_sampler.train()(call.clouds).points
        task_loss = old_task.net(points).square().mean()
        loss = task_loss + 2 * subset_loss(call.clouds, points)
    loss.backward()
    assert_stepped(old_task, task, learn != "sampler")
    assert_stepped(old_sampler, sampler, learn != "task")


def assert_stepped(old, new, learns):
    """Assert one step of gradient descent with a rate of 0.01, or none."""
    for before, after in zip(old.parameters(), new.parameters(), strict=True):
        expected = before.detach()
        if learns:
            assert before.grad is not None
            expected = expected - 0.01 * before.grad
        torch.testing.assert_close(after.detach(), expected)
