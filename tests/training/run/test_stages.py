"""Which clouds each phase of a run sees, as the task net's calls tell."""

from collections import Counter

import pytest
import torch

from mops_lightning.config.compose import compose
from mops_lightning.seeding import generator
from mops_lightning.training.run.run import run
from mops_lightning.zoo.load import load
from tests.support.command_line import TINY_ANY_DATA
from tests.support.recording import FIRST_TEST_CLOUD, numbered_clouds

EPOCHS, TRAIN, HELD_OUT, TEST, BATCH = 3, 16, 4, 10, 4
SETTINGS = [
    *(one for one in TINY_ANY_DATA if not one.startswith(("trainer.max_epochs", "batch_size"))),
    "task._target_=tests.support.recording.RecordingTask",
    "task.net._target_=tests.support.recording.Fingerprint",
    "dataset._target_=tests.support.recording.numbered_clouds",
    f"dataset.train_per_class={TRAIN}",
    f"dataset.test_per_class={TEST}",
    f"val_fraction={HELD_OUT / TRAIN}",
    f"trainer.max_epochs={EPOCHS}",
    f"batch_size={BATCH}",
    "weights=null",
    "recipe=paper",
    "seed=3",
]


def numbers(calls):
    return [label for call in calls for label in call.labels]


def clouds_of(calls):
    """The clouds that arrived, in the order of their numbers, each once."""
    found: dict[int, torch.Tensor] = {}
    for call in calls:
        found |= dict(zip(call.labels, call.clouds, strict=True))
    return torch.stack([found[number] for number in sorted(found)])


@pytest.mark.parametrize(
    ("learn", "changes", "readouts", "tested"),
    [
        # Tested are 3 readouts, 1 baseline (of a task of one's own) and the full clouds.
        ("sampler", ["+augment.sampler.jitter=0.1", "test_noise_std=0.1"], 3, 5),
        ("task", ["augment.task={rotate_up: true}"], 1, 1),
    ],
)
def test_run_phases_see_disjoint_complete_clouds(learn, changes, readouts, tested, calls, tmp_path):
    overrides = [*SETTINGS, f"learn={learn}", *changes, f"cache={tmp_path}/cache"]
    run(compose(overrides), tmp_path / "run", overrides)
    steps = (TRAIN - HELD_OUT) // BATCH
    orders, held_out = [], []
    for epoch in range(EPOCHS):
        begin = epoch * (steps + readouts)
        training, validation = calls[begin : begin + steps], calls[begin + steps :][:readouts]
        assert all(call.training for call in training)
        assert not any(call.training for call in validation)
        orders.append(numbers(training))
        assert len({tuple(call.labels) for call in validation}) == 1
        held_out.append(validation[0].labels)
    test = calls[EPOCHS * (steps + readouts) :]
    assert not any(call.training for call in test)
    # Every training cloud once per epoch, in a new order; the held-out clouds always the same.
    assert all(sorted(order) == sorted(orders[0]) for order in orders)
    assert len({tuple(order) for order in orders}) == EPOCHS
    shuffled = torch.randperm(len(orders[0]), generator=generator(3, 0)).tolist()
    assert orders[0] == [sorted(orders[0])[row] for row in shuffled]
    assert held_out == [held_out[0]] * EPOCHS
    assert sorted([*orders[0], *held_out[0]]) == list(range(TRAIN))
    assert len(held_out[0]) == HELD_OUT
    expected = range(FIRST_TEST_CLOUD, FIRST_TEST_CLOUD + TEST)
    assert Counter(numbers(test)) == dict.fromkeys(expected, tested)
    assert_only_these_changed(changes, calls, held_out[0])


def test_run_with_moving_average_tests_and_saves_the_average(calls, tmp_path):
    overrides = [*SETTINGS, "recipe.ema_span=0.5", f"cache={tmp_path}/cache"]
    run(compose(overrides), tmp_path / "run", overrides)
    sampler, name = load(tmp_path / "run"), "queries.weight"
    kept = torch.load(tmp_path / "run" / "checkpoints" / "last.ckpt", weights_only=True)
    average, last = (kept[key][f"sampler.{name}"] for key in ("state_dict", "current_model_state"))
    assert torch.equal(sampler.state_dict()[name], average)
    assert not torch.allclose(average, last)
    tested = next(call for call in calls if min(call.labels) >= FIRST_TEST_CLOUD)
    with torch.no_grad():
        torch.testing.assert_close(sampler(tested.clouds).points, tested.points)


def assert_only_these_changed(changes, calls, held_out):
    """Augmentation changes training clouds only, and noise test clouds only."""
    data = numbered_clouds(64, TRAIN, TEST)
    kept = sorted(set(range(TRAIN)) - set(held_out))
    phases = {
        "augment": ([call for call in calls if call.training], data.train.points[kept]),
        "val": (
            [call for call in calls if set(call.labels) == set(held_out)],
            data.train.points[sorted(held_out)],
        ),
        "test": ([call for call in calls if min(call.labels) >= 1000], data.test.points),
    }
    for phase, (seen, original) in phases.items():
        differ = not torch.equal(clouds_of(seen), original)
        assert differ == any(change.lstrip("+").startswith(phase) for change in changes), phase
