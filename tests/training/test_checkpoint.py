"""A run that is stopped and resumed, also several times, gets the weights of an unbroken one."""

import io
import os
import pickle
import signal
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from torch import nn
from torch.optim import Adam

from mops_lightning.config.settings import Learn
from mops_lightning.data.loader import Augmentation, CloudLoader
from mops_lightning.errors import Interrupted, UserError
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.tasks.classification import Classification
from mops_lightning.training.checkpoint import (
    CHECKPOINT,
    CHECKPOINT_KEY,
    LENGTH,
    find_checkpoint,
    read_sealed,
    sealed,
)
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.muon import MuonAdam
from mops_lightning.training.recipe.moving_average import MovingAverage
from mops_lightning.training.recipe.recipe import Recipe
from mops_lightning.training.run.callbacks import last_checkpoint
from mops_lightning.training.run.checkpoint_io import AtomicCheckpointIO
from mops_lightning.training.run.ending import StopWithCheckpoint
from mops_lightning.training.schedules import one_cycle
from tests.support.training import quiet_trainer, small_dataset

pytestmark = pytest.mark.filterwarnings(
    "ignore:Checkpoint directory .* not empty", "ignore:.*callbacks used to create the checkpoint"
)

EPOCHS = 4
CLOUDS = 12


class Setting(NamedTuple):
    """What is trained; the recipe is ``fast`` or ``paper``."""

    learn: Learn
    fast: bool = False
    steps: int = 3
    accumulated: int = 1


SETTINGS = [
    Setting("sampler", fast=True, steps=1),
    Setting("joint", accumulated=2),
    Setting("task", steps=1),
    Setting("sampler", fast=True),
    Setting("joint", steps=1),
    Setting("sampler"),
    Setting("task"),
    Setting("sampler", steps=1),
]


class SmallNet(nn.Module):
    """A classifier with dropout and BatchNorm, whose state must be restored, too."""

    def __init__(self):
        super().__init__()
        self.features = nn.Linear(3, 16)
        self.head = nn.Sequential(
            nn.BatchNorm1d(16),
            nn.ReLU(),
            nn.Dropout(),
            nn.Linear(16, 3),
        )

    def forward(self, points):
        return self.head(self.features(points).amax(1))


class Killed(BaseException):
    """Ends an attempt where SIGKILL would end its process."""


class StopAt(Callback):
    """Sends Ctrl-C, or kills the run, when a hook has come after some training steps."""

    def __init__(self, stop, steps):
        self.kind, self.place = stop
        self.left = steps

    def _reach(self, place):
        if place == self.place and self.left <= 0:
            self.place = ""
            if self.kind == "kill":
                raise Killed
            signal.raise_signal(signal.SIGINT)

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        self.left -= 1
        place = "step"
        if batch_idx + 1 == trainer.num_training_batches:
            place = "last step"
        self._reach(place)

    def on_validation_start(self, trainer, pl_module):
        self._reach("validation")

    def on_train_epoch_end(self, trainer, pl_module):
        self._reach("epoch end")

    def on_test_start(self, trainer, pl_module):
        self._reach("test")


STOPS = [
    ("ctrl-c", "step"),
    ("ctrl-c", "last step"),
    ("ctrl-c", "validation"),
    ("ctrl-c", "epoch end"),
    ("kill", "step"),
    ("kill", "last step"),
    ("kill", "validation"),
    ("kill", "epoch end"),
    ("kill", "test"),
]


def each_after_each(items):
    """Return items so that each one follows each, itself too, once: a de Bruijn sequence."""
    in_turn = []
    for number, item in enumerate(items):
        in_turn.append(item)
        for later in items[number + 1 :]:
            in_turn += [item, later]
    return in_turn


IN_TURN = each_after_each(STOPS)


def attempt(setting: Setting, path: Path, *callbacks: Callback) -> Any:
    """Train and test from ``path`` where it exists: the final weights, None if it was stopped."""
    learn, fast, steps, accumulated = setting
    torch.manual_seed(0)
    sampler: MOPSNet | None = MOPSNet(4, feature_channels=(4, 4), rho_channels=(8, 4))
    if learn == "task":
        sampler = None
    optimizer: Any = partial(Adam, lr=1e-2)
    recipe = Recipe()
    average: list[Callback] = []
    if fast:
        optimizer = partial(MuonAdam, smallest=3, lr=1e-2)
        recipe = Recipe(ema_span=0.3, train_points=16, all_points_from=0.5, distillation=1.0)
        average = [MovingAverage(0.3)]
    module = Experiment(
        Classification(SmallNet(), 3),
        sampler,
        learn,
        make_optimizer=optimizer,
        make_schedule=one_cycle,
        recipe=recipe,
    )
    trainer = quiet_trainer(
        EPOCHS,
        callbacks=[*average, *callbacks, last_checkpoint(path), StopWithCheckpoint(path)],
        enable_checkpointing=True,
        accumulate_grad_batches=accumulated,
    )
    data = small_dataset(train=CLOUDS, test=3, points=24)
    train = CloudLoader(
        data.train,
        CLOUDS // steps,
        shuffle=True,
        augment=Augmentation(rotate_up=True, jitter=0.01),
        drop_last=True,
    )
    test = CloudLoader(data.test, 3)
    checkpoint = None
    if path.is_file():
        checkpoint = path
    try:
        trainer.fit(module, train, test, ckpt_path=checkpoint)
        trainer.test(module, test, verbose=False)
    except (Interrupted, Killed):
        return None
    return module.state_dict()


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    """A function that returns the weights of a training without a stop, which is run once."""
    folder = tmp_path_factory.mktemp("unbroken")

    @cache
    def run_once(setting):
        return attempt(setting, folder / str(setting) / "last.ckpt")

    return run_once


def assert_same(state, want):
    for name, value in want.items():
        assert torch.equal(state[name], value), name


@pytest.mark.parametrize("number", range(0, len(IN_TURN), 2))
def test_run_stopped_three_times_resumes_to_same_weights(unbroken, tmp_path, number):
    path = tmp_path / "last.ckpt"
    setting = SETTINGS[number // 2 % len(SETTINGS)]
    around = [*IN_TURN, *IN_TURN]
    first, second, third = around[number : number + 3]

    state = attempt(setting, path, StopAt(first, steps=2))
    for stop in (second, third):
        if state is None:  # otherwise the place of the last stop was not reached
            state = attempt(setting, path, StopAt(stop, steps=1))
    if state is None:
        state = attempt(setting, path)

    assert_same(state, unbroken(setting))


@pytest.mark.parametrize("setting", SETTINGS, ids=str)
def test_completed_run_resumes_to_same_weights(unbroken, tmp_path, setting):
    path = tmp_path / "last.ckpt"
    attempt(setting, path)

    again = attempt(setting, path)

    assert_same(again, unbroken(setting))


def test_checkpoint_written_in_last_step_of_epoch_resumes_to_same_weights(unbroken, tmp_path):
    path = tmp_path / "last.ckpt"
    setting = Setting("joint")
    saves = ModelCheckpoint(
        dirpath=tmp_path,
        filename="last",
        every_n_train_steps=3,
        enable_version_counter=False,
    )
    attempt(setting, path, saves, StopAt(("kill", "validation"), 3))

    stopped = attempt(setting, path, StopAt(("ctrl-c", "step"), 2))
    state = attempt(setting, path)

    assert stopped is None
    assert_same(state, unbroken(setting))


class Touch:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


@pytest.mark.parametrize("plain", [True, False])
def test_read_sealed_runs_no_pickled_code(plain, tmp_path):
    content = {"state": Touch(tmp_path / "ran")}
    written = pickle.dumps(content)
    if not plain:
        buffer = io.BytesIO()
        torch.save(content, buffer)
        written = buffer.getvalue()
    path = tmp_path / "a.ckpt"
    path.write_bytes(sealed(written))

    with pytest.raises(UserError, match="expected a checkpoint of plain data"):
        read_sealed(path)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("change", ["byte", "cut", "saved again", "empty"])
def test_read_sealed_of_a_changed_checkpoint_raises(change, tmp_path):
    path = tmp_path / "last.ckpt"
    weight = torch.ones(50)
    AtomicCheckpointIO().save_checkpoint({"epoch": 3, "weight": weight}, path)
    assert read_sealed(path)["epoch"] == 3
    written = path.read_bytes()

    if change == "saved again":
        content = torch.load(path)
        content["epoch"] = 2
        torch.save(content, path)
    elif change == "byte":
        flipped = bytearray(written)
        flipped[written.index(weight.numpy().tobytes())] ^= 1
        path.write_bytes(flipped)
    elif change == "cut":
        path.write_bytes(written[:-1])
    else:
        path.write_bytes(b"")

    with pytest.raises(UserError, match=r"last\.ckpt is damaged .*expected a checkpoint as"):
        read_sealed(path)


@pytest.mark.parametrize("newest", ["a", "b", "c"])
def test_last_is_the_newest_run_with_these_settings(newest, tmp_path):
    identity = {"sampler": "fps", LENGTH: "9"}
    for number, name in enumerate("abcd"):
        path = tmp_path / name / "checkpoints" / CHECKPOINT
        path.parent.mkdir(parents=True)
        identity_of_run = identity
        written_at = 1000 + number
        if name == "d":
            identity_of_run = {**identity, "sampler": "random"}
            written_at = 3000
        elif name == newest:
            written_at = 2000
        loop = {"epoch_progress": {"current": {"processed": 3}}}
        content = {
            CHECKPOINT_KEY: identity_of_run,
            "loops": {"fit_loop": loop},
            "global_step": 12,
        }
        AtomicCheckpointIO().save_checkpoint(content, path)
        os.utime(path, (written_at, written_at))

    found = find_checkpoint("last", tmp_path, identity)

    assert found.path.parts[-3] == newest
