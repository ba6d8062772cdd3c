"""Which clouds each phase of a run sees, as the task net's calls tell."""

from collections import Counter

import pytest
import torch

from mops_lightning.config.compose import compose
from mops_lightning.seeding import generator
from mops_lightning.training.run.run import run
from mops_lightning.zoo.load import load
from tests.support.recording import FIRST_TEST_CLOUD, numbered_clouds

EPOCHS = 3
TRAIN = 16
HELD_OUT = 4
TEST = 10
BATCH = 4
SETTINGS = [
    "trainer=cpu",
    "epochs.task=1",
    "dataset.n_points=64",
    "m=8",
    "pictures=0",
    "logger=none",
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
    clouds: dict[int, torch.Tensor] = {}
    for call in calls:
        for number, cloud in zip(call.labels, call.clouds, strict=True):
            clouds[number] = cloud
    return torch.stack([clouds[number] for number in sorted(clouds)])


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
    orders = []
    held_out = []
    rest = list(calls)
    for _ in range(EPOCHS):
        training = rest[:steps]
        validation = rest[steps : steps + readouts]
        rest = rest[steps + readouts :]
        assert all(call.training for call in training)
        assert not any(call.training for call in validation)
        orders.append(numbers(training))
        held_out += [call.labels for call in validation]
    assert not any(call.training for call in rest)
    # Every training cloud once per epoch, in a new order; the held-out clouds always the same.
    first = orders[0]
    assert all(sorted(order) == sorted(first) for order in orders)
    assert len({tuple(order) for order in orders}) == EPOCHS
    shuffled = torch.randperm(len(first), generator=generator(3, 0)).tolist()
    assert first == [sorted(first)[row] for row in shuffled]
    assert held_out == [held_out[0]] * EPOCHS * readouts
    assert sorted([*first, *held_out[0]]) == list(range(TRAIN))
    assert len(held_out[0]) == HELD_OUT
    expected = range(FIRST_TEST_CLOUD, FIRST_TEST_CLOUD + TEST)
    assert Counter(numbers(rest)) == dict.fromkeys(expected, tested)
    assert_only_these_changed(changes, calls, held_out[0])


def test_run_with_moving_average_tests_and_saves_the_average(calls, tmp_path):
    overrides = [*SETTINGS, "recipe.ema_span=0.5", f"cache={tmp_path}/cache"]

    run(compose(overrides), tmp_path / "run", overrides)

    sampler = load(tmp_path / "run")
    checkpoint = torch.load(tmp_path / "run" / "checkpoints" / "last.ckpt", weights_only=True)
    average = checkpoint["state_dict"]["sampler.queries.weight"]
    last = checkpoint["current_model_state"]["sampler.queries.weight"]
    assert torch.equal(sampler.state_dict()["queries.weight"], average)
    assert not torch.allclose(average, last)
    tested = next(call for call in calls if min(call.labels) >= FIRST_TEST_CLOUD)
    with torch.no_grad():
        torch.testing.assert_close(sampler(tested.clouds).points, tested.points)


def assert_only_these_changed(changes, calls, held_out):
    """Augmentation changes training clouds only, and noise test clouds only."""
    data = numbered_clouds(64, TRAIN, TEST)
    kept = sorted(set(range(TRAIN)) - set(held_out))
    in_training = [call for call in calls if call.training]
    in_validation = [call for call in calls if set(call.labels) == set(held_out)]
    in_test = [call for call in calls if min(call.labels) >= FIRST_TEST_CLOUD]
    settings = " ".join(changes)

    is_augmented = not torch.equal(clouds_of(in_training), data.train.points[kept])
    is_noisy = not torch.equal(clouds_of(in_test), data.test.points)

    assert is_augmented == ("augment" in settings)
    assert is_noisy == ("test_noise_std" in settings)
    assert torch.equal(clouds_of(in_validation), data.train.points[sorted(held_out)])
