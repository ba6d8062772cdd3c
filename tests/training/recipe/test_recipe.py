"""Recipes: what a training step sees, what it adds to the loss, and which weights are kept."""

from functools import partial
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from mops_lightning import MOPSNet
from mops_lightning.config.build import build
from mops_lightning.config.compose import compose
from mops_lightning.data.loader import CloudLoader
from mops_lightning.errors import UserError
from mops_lightning.nets.pcrnet import PCRNet
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.tasks.classification import Classification
from mops_lightning.tasks.registration import Registration
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.recipe.distillation import feature_distance, pooled_features
from mops_lightning.training.recipe.moving_average import MovingAverage
from mops_lightning.training.recipe.recipe import Recipe, draw_points, straight_through
from mops_lightning.types import Batch
from tests.support.recording import Fingerprint, RecordingTask, noting
from tests.support.training import quiet_trainer, small_dataset

POINTS = 48


def trained(recipe, epochs=2, **more):
    """Train on 24 clouds in batches of 6."""
    sampler = noting(MOPSNet, 8, feature_channels=(8, 8), rho_channels=(16, 8))
    task = Classification(PointNetVanilla(3), 3)
    adam = partial(torch.optim.Adam, lr=1e-2)
    module = Experiment(task, sampler, make_optimizer=adam, recipe=recipe)
    data = small_dataset(points=POINTS)
    train = CloudLoader(data.train, 6, shuffle=True)
    quiet_trainer(epochs, **more).fit(module, train, CloudLoader(data.test, 6))
    return module


def numbers_seen(module, training):
    """How many points the sampler was given in each step."""
    numbers = []
    for in_training, points, _ in module.sampler.samples:
        if in_training == training:
            numbers.append(points.shape[1])
    return numbers


def test_recipe_paper_is_the_default_and_differs_from_fast(composed):
    assert Recipe() == Recipe(None, None, None, False, 0.0, 0.0, None, None)
    assert build(composed, "recipe") == Recipe()
    assert build(compose().recipe, "recipe") != Recipe()


def test_task_points_are_drawn_for_task_net_alone(calls):
    data = small_dataset(points=POINTS)
    recipe = Recipe(task_points=16)
    task = RecordingTask(Fingerprint())
    module = Experiment(task, None, "task", torch.optim.Adam, recipe=recipe)

    train = CloudLoader(data.train, 6)
    val = CloudLoader(data.test, 6)

    quiet_trainer(1).fit(module, train, val)

    in_training = {call.points.shape[1] for call in calls if call.training}
    in_validation = {call.points.shape[1] for call in calls if not call.training}
    assert in_training == {16}
    assert in_validation == {POINTS}


def test_task_points_are_not_drawn_for_a_sampler():
    module = trained(Recipe(task_points=16), epochs=1)

    assert set(numbers_seen(module, training=True)) == {POINTS}


@pytest.fixture(scope="module")
def composed():
    return compose(["recipe=paper"]).recipe


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("train_points", 0),
        ("task_points", 0),
        ("all_points_from", 1.5),
        ("straight_through", -0.1),
        ("ema_span", float("nan")),
        ("distillation", -1.0),
        ("distillation", float("inf")),
        ("feature_distillation", -1.0),
    ],
)
def test_recipe_value_out_of_range_raises(composed, name, value):
    with pytest.raises(UserError, match=rf"{name} must be .* got"):
        Recipe(**{name: value})
    with pytest.raises(UserError, match=rf"recipe.{name} must be .* got"):
        build(OmegaConf.merge(composed, {name: value}), "recipe")


def test_recipe_accepts_limits():
    for share in (0.0, 1.0):
        Recipe(all_points_from=share, straight_through=share, ema_span=share)
    Recipe(train_points=1, task_points=1)


def test_shares_of_the_training_include_their_first_step():
    recipe = Recipe(train_points=64, all_points_from=0.5, straight_through=0.25)

    assert recipe.points_at(0.49, 1024, 8) == 64
    assert recipe.points_at(0.5, 1024, 8) == 1024
    assert not recipe.sees_matched(0.24)
    assert recipe.sees_matched(0.25)
    assert not Recipe().sees_matched(1.0)


def test_training_sees_drawn_points_then_all_and_validation_always_all():
    module = trained(Recipe(train_points=20, all_points_from=0.5))

    drawn_then_all = [20, 20, 20, 20, POINTS, POINTS, POINTS, POINTS]
    assert numbers_seen(module, training=True) == drawn_then_all
    assert set(numbers_seen(module, training=False)) == {POINTS}


def test_points_at_is_at_least_twice_the_sample_or_as_many_as_for_a_task_net_alone():
    recipe = Recipe(train_points=256, task_points=128)

    assert recipe.points_at(0, 1024, 32) == 256
    assert recipe.points_at(0, 1024, 200) == 400
    assert recipe.points_at(0, 1024, 800) == 1024
    assert Recipe().points_at(0, 1024, 32) == 1024
    assert recipe.points_at(0, 1024, 0) == 128
    assert recipe.points_at(0, 100, 0) == 100
    assert Recipe(train_points=64).points_at(0, 1024, 0) == 1024


def test_draw_points_returns_distinct_rows_new_in_every_draw():
    cloud = torch.arange(POINTS * 3.0).view(1, POINTS, 3)
    batch = Batch(cloud.repeat(2, 1, 1), torch.zeros(2))
    torch.manual_seed(0)

    first = rows_of(draw_points(batch, 30))
    second = rows_of(draw_points(batch, 30))

    for rows in (*first, *second):
        assert len(set(rows)) == 30
        assert set(rows) <= set(range(POINTS))
    of_one_cloud, of_another = first
    assert set(of_one_cloud) != set(of_another)
    assert first != second
    assert draw_points(batch, POINTS) is batch.points


def rows_of(points):
    """Return the rows of points whose first coordinate is three times their row."""
    return (points[..., 0] / 3).tolist()


def test_draw_points_keeps_the_rows_of_a_pair():
    points = torch.randn(3, POINTS, 3)
    generators = [torch.Generator().manual_seed(seed) for seed in range(3)]
    task = Registration(PCRNet())
    pairs = task.make_batch(points, generators)

    drawn = draw_points(pairs, 10)

    source, target = drawn.chunk(2)
    full_source, full_target = pairs.points.chunk(2)
    to_source = torch.cdist(source, full_source)
    to_target = torch.cdist(target, full_target)
    assert torch.equal(to_source.argmin(2), to_target.argmin(2))


def test_straight_through_has_matched_values_and_gradients_of_generated():
    points = torch.randn(2, POINTS, 3)
    generated = (points[:, :5] + 1e-3).requires_grad_()
    weight = torch.randn(2, 5, 3)

    matched = straight_through(generated, points)
    (matched * weight).sum().backward()

    torch.testing.assert_close(matched.detach(), points[:, :5])
    torch.testing.assert_close(generated.grad, weight)


def test_moving_average_ends_with_the_average_of_all_steps():
    steps: list[torch.Tensor] = []

    class Watch(MovingAverage):
        def on_train_batch_end(self, trainer: Any, pl_module: Any, *args: Any) -> None:
            steps.append(pl_module.sampler.queries.weight.detach().clone())
            super().on_train_batch_end(trainer, pl_module, *args)

    module = trained(Recipe(), callbacks=[Watch(0.5)])

    assert len(steps) == 8
    span = 0.5 * 8
    decay = 1 - 1 / span
    expected = steps[0]
    for weights in steps[1:]:
        expected = decay * expected + (1 - decay) * weights
    torch.testing.assert_close(module.state_dict()["sampler.queries.weight"], expected)
    assert not torch.allclose(expected, steps[-1])


def test_moving_average_keeps_frozen_net_and_counters_of_batches():
    before: dict[str, torch.Tensor] = {}

    class Count(MovingAverage):
        def on_train_start(self, trainer: Any, pl_module: Any) -> None:
            super().on_train_start(trainer, pl_module)
            for buffer in pl_module.task.buffers():
                if not buffer.is_floating_point():
                    buffer.fill_(6140)
            assert self._average_model is not None
            self._average_model.module.load_state_dict(pl_module.state_dict())
            for name, value in pl_module.task.state_dict().items():
                before[name] = value.clone()

    module = trained(Recipe(), callbacks=[Count(0.7)])

    after = module.task.state_dict()
    assert any(name.endswith("num_batches_tracked") for name in before)
    for name, value in before.items():
        assert torch.equal(after[name], value), name
    counts = set()
    for buffer in module.sampler.buffers():
        if not buffer.is_floating_point():
            counts.add(int(buffer))
    assert counts == {module.total_steps}


def test_feature_distance_is_relative_to_the_reference():
    features = torch.tensor([[1.0, 2.0], [0.0, 3.0]])
    reference = torch.tensor([[3.0, 4.0], [0.0, 3.0]])

    distance = feature_distance(features, reference)

    of_first = (2**2 + 2**2) / (3**2 + 4**2)
    of_second = 0.0
    assert distance == pytest.approx((of_first + of_second) / 2)


def test_feature_distillation_of_net_without_point_features_raises():
    net = torch.nn.Linear(3, 3)
    points = torch.randn(2, 7, 3)

    with pytest.raises(UserError, match=r"feature_distillation must be 0 .* got Linear"):
        pooled_features(net, points)
