"""What a run left out, for its record: reports keep such a run out of their tables."""

import math
from collections.abc import Mapping
from typing import Any

import lightning as L

from mops_lightning.config.shortened import shortening
from mops_lightning.records.run_record import RunRecord

OF_TEST = "tested on"
"""Begins the reasons that are about the test alone."""


def note_training(trainer: L.Trainer, batches: int, record: RunRecord) -> None:
    """Note a training on part of the batches, or of fewer steps than planned.

    Early stopping is a plan of its own.

    Args:
        trainer: after its training.
        batches: of a whole epoch.
        record: to fill.
    """
    settings = record.config["trainer"]
    for name in ("fast_dev_run", "overfit_batches"):
        if settings.get(name):
            record.partial.append(f"tried with trainer.{name}={settings[name]}")
    skipped = trainer.limit_train_batches == 0
    seen = 0 if skipped else int(trainer.num_training_batches)
    if seen < batches:
        record.partial.append(f"trained on {seen} of {batches} batches of an epoch")
    of_epoch = math.ceil(seen / trainer.accumulate_grad_batches)
    planned = of_epoch * settings["max_epochs"]
    steps = trainer.global_step
    if steps < planned and trainer.early_stopping_callback is None:
        record.partial.append(f"trained for {steps} of {planned} steps")


def note_test(trainer: L.Trainer, batches: int, record: RunRecord) -> None:
    """Note a test of part of the ``batches``."""
    tested = sum(trainer.num_test_batches)  # empty with a limit of 0
    if tested < batches:
        record.partial.append(f"{OF_TEST} {tested} of {batches} batches")


def note_task_net(config: Mapping[str, Any], record: RunRecord) -> None:
    """Note that the loaded task net comes from a shortened training.

    Args:
        config: of the run that trained the net, from its weights file.
        record: to fill.
    """
    if reasons := shortening(config):
        record.partial.append(f"used a task net trained with {' '.join(reasons)}")


def note_evaluated(name: str, trained: RunRecord, record: RunRecord) -> None:
    """Note that the run which is tested again was shortened.

    Args:
        name: of that run.
        trained: its record.
        record: to fill.
    """
    reasons = [reason for reason in trained.partial if not reason.startswith(OF_TEST)]
    if reasons:
        record.partial.append(f"tested {name}, which was {' and '.join(reasons)}")
