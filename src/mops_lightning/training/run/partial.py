"""Notes on shortened training or tests, in the record: reports leave such runs out of tables."""

import math
from collections.abc import Mapping
from typing import Any

import lightning as L
from lightning.pytorch.callbacks.early_stopping import EarlyStoppingReason

from mops_lightning.config.shortened import planned_steps, shortening
from mops_lightning.records.run_record import RunRecord

OF_TEST = "tested on"
"""Begins the reasons that are about the test alone."""


def note_training(trainer: L.Trainer, batches: int, record: RunRecord) -> None:
    """Note a training on part of the batches, or of fewer steps than planned.

    Early stopping is a plan of its own.

    Args:
        trainer: after its training.
        batches: batches of a whole epoch.
        record: the run's record, which is filled.
    """
    settings = record.config["trainer"]
    for name in ("fast_dev_run", "overfit_batches"):
        if settings.get(name):
            record.partial.append(f"tried with trainer.{name}={settings[name]}")
    seen = _seen_batches(trainer)
    if seen < batches:
        record.partial.append(f"trained on {seen} of {batches} batches of an epoch")
    of_epoch = math.ceil(seen / trainer.accumulate_grad_batches)
    planned = planned_steps(settings, of_epoch)
    steps = trainer.global_step
    if steps < planned and not _has_stopped_early(trainer):
        record.partial.append(f"trained for {steps} of {planned} steps")


def _seen_batches(trainer: L.Trainer) -> int:
    """Return the batches of an epoch that were trained on."""
    if trainer.limit_train_batches == 0:
        return 0
    return int(trainer.num_training_batches)


def _has_stopped_early(trainer: L.Trainer) -> bool:
    """Return whether early stopping ended the training, not a limit before it."""
    for callback in trainer.early_stopping_callbacks:
        if callback.stopping_reason is not EarlyStoppingReason.NOT_STOPPED:
            return True
    return False


def note_test(trainer: L.Trainer, batches: int, record: RunRecord) -> None:
    """Note a test of part of the ``batches``, or without scores."""
    if trainer.barebones:  # Lightning logs nothing, and scores are what is logged
        record.partial.append(f"{OF_TEST} all clouds without scores (trainer.barebones)")
        return
    tested = sum(trainer.num_test_batches)  # empty with a limit of 0
    if tested < batches:
        record.partial.append(f"{OF_TEST} {tested} of {batches} batches")


def note_task_net(config: Mapping[str, Any], record: RunRecord) -> None:
    """Note that the loaded task net comes from a shortened training.

    Args:
        config: settings of the run that trained the net, from its weights file.
        record: the record of the run that uses it.
    """
    reasons = shortening(config)
    if reasons:
        record.partial.append(f"used a task net trained with {' '.join(reasons)}")


def note_evaluated(name: str, trained: RunRecord, record: RunRecord) -> None:
    """Note that the run which is tested again was shortened.

    Args:
        name: name of the tested run.
        trained: the tested run's record.
        record: the record of the test.
    """
    reasons = [reason for reason in trained.partial if not reason.startswith(OF_TEST)]
    if reasons:
        how = " and ".join(reasons)
        record.partial.append(f"tested {name}, which was {how}")
