"""Chains of stops at random moments: the same command again gives the same weights and scores.

SIGTERM or Ctrl-C arrives inside an optimizer step, in a validation, in a test, between two epochs
or at the start of a stage, also in the training of the task net. A short round in the suite;
``make fuzz`` runs many chains.
"""

import os
import random
import signal

import pytest

from mops_lightning.records import run_record
from mops_lightning.training.experiment import Experiment
from mops_lightning.zoo import weights
from tests.support.command_line import TINY, call, done, job

LONG = int(os.environ.get("MOPS_FUZZ", "0"))
"""Command lines of the long round; a sixteenth of it: chains; 0: the short round."""
CHAINS = LONG // 16
MOST_STOPS = 3

SHORT = [*TINY, "baselines={}", "trainer.max_epochs=3", "epochs.task=2", "val_fraction=0.25"]
UNTRAINED_NET = [*SHORT, "weights=null"]
EARLY_STOPPING = [
    "+callbacks.early._target_=lightning.pytorch.callbacks.EarlyStopping",
    "+callbacks.early.monitor=val/completed/accuracy",
    "+callbacks.early.patience=1",
    "+callbacks.early.min_delta=100",
]
STAGES = [
    "task/net=hierarchical",
    "sampler@task.net.sampler=mops",
    "task.net.points=[16,8]",
    "task.net.channels=[8,8,8]",
    "task.net.k=4",
]
KINDS = {
    "pretraining": SHORT,
    "early stopping": [*UNTRAINED_NET, *EARLY_STOPPING, "trainer.max_epochs=5"],
    "muon": [*UNTRAINED_NET, "optimizer=muon"],
    "several nets": [*SHORT, "other_nets=[NET1,NET2]", "recipe.nets_per_step=1"],
    "segmentation": [
        *UNTRAINED_NET,
        "task=segmentation",
        "task.net.points=[16,8]",
        "dataset.classes=[lamp]",
        "dataset.train_per_class=12",
    ],
    "hierarchical stages": [*SHORT, "learn=task", *STAGES],
    "joint, many sizes": [*UNTRAINED_NET, "learn=joint", "sampler=fmops", "sampler.m_max=16"],
    "accumulated gradients": [*UNTRAINED_NET, "+trainer.accumulate_grad_batches=2"],
    "validation inside epochs": [*UNTRAINED_NET, "+trainer.val_check_interval=1"],
}
"""Command lines; NET1 and NET2 stand for trained task nets."""

MOMENTS = (
    "on_fit_start",
    "on_before_zero_grad",
    "on_validation_batch_end",
    "on_train_epoch_end",
    "on_test_start",
    "on_test_batch_end",
)
"""Hooks of the experiment at which a signal may arrive."""


@pytest.fixture(scope="module")
def nets(tmp_path_factory):
    """The folders of two trained task nets, by their names in a command line."""
    folder = tmp_path_factory.mktemp("nets")
    for number in (1, 2):
        job(folder / f"net{number}", "learn=task", f"seed={number}", "dataset.seed=0")
    return {f"NET{number}": str(folder / f"net{number}") for number in (1, 2)}


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory, nets):
    """A function that returns the result and the number of moments of an undisturbed run."""
    found = {}

    def of(kind):
        if kind not in found:
            folder = tmp_path_factory.mktemp("unbroken")
            with pytest.MonkeyPatch.context() as patched:
                moments = signal_at(patched, None)
                done([*command(kind, nets), "hydra.run.dir=out/0"], folder)
            found[kind] = result(folder / "out" / "0"), len(moments)
        return found[kind]

    return of


def command(kind, nets):
    """The arguments of a kind, with the folders of the nets in the place of their names."""
    text = "\n".join(KINDS[kind])
    for name, folder in nets.items():
        text = text.replace(name, folder)
    return text.split("\n")


def signal_at(patched, moment, number=signal.SIGTERM):
    """Send a signal at the n-th moment of a run; None: never. Returns the list of moments."""
    moments = []

    def hook(name):
        before = getattr(Experiment, name, None)

        def noting(self, *arguments, **named):
            moments.append(name)
            if len(moments) == moment:
                signal.raise_signal(number)
            return None if before is None else before(self, *arguments, **named)

        return noting

    for name in MOMENTS:
        patched.setattr(Experiment, name, hook(name), raising=False)
    return moments


def result(folder):
    """What must be equal."""
    record = run_record.read(folder)
    assert record.status == "completed", record.error
    digest = weights.read(folder / weights.FILE)["sha256"]
    return digest, record.metrics, record.validation, record.partial


def check_chain(kind, nets, want, moments, rng, folder):
    """Stop a run up to ``MOST_STOPS`` times, then let it end: its result is the unbroken one's."""
    arguments = command(kind, nets)
    stops = []
    for attempt in range(MOST_STOPS + 1):
        signal.signal(signal.SIGINT, signal.default_int_handler)  # Lightning leaves it ignored
        resumes = any((folder / "out").glob("*/checkpoints/last.ckpt"))
        again = ["ckpt_path=last", "out=out"] if resumes else ["out=out"]
        # The last attempt is left alone.
        moment = rng.randint(1, moments) if attempt < MOST_STOPS else None
        with pytest.MonkeyPatch.context() as patched:
            signal_at(patched, moment, rng.choice([signal.SIGTERM, signal.SIGINT]))
            status, out, err = call([*arguments, *again, f"hydra.run.dir=out/{attempt}"], folder)
        stops.append((moment, status))
        assert "Traceback" not in err, (kind, stops, err)
        if status == 0:
            break
        assert status == 130, (kind, stops, out, err)
    assert result(folder / "out" / str(attempt)) == want, (kind, stops)


@pytest.mark.parametrize("kind", ["pretraining", "early stopping"])
def test_run_that_is_stopped_again_and_again_ends_as_the_unbroken_one(
    kind, nets, unbroken, tmp_path
):
    want, moments = unbroken(kind)
    assert moments > 10
    check_chain(kind, nets, want, moments, random.Random(1), tmp_path)


@pytest.mark.skipif(not LONG, reason="the long round: make fuzz")
@pytest.mark.parametrize("number", range(CHAINS))
def test_chain_of_stops_ends_as_the_unbroken_run(number, nets, unbroken, tmp_path):
    kind = list(KINDS)[number % len(KINDS)]
    want, moments = unbroken(kind)
    check_chain(kind, nets, want, moments, random.Random(1000 * LONG + number), tmp_path)
