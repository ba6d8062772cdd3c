"""Lightning callbacks of a run: checkpoints, CPU time, progress."""

import sys
import time
from copy import deepcopy
from pathlib import Path
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import Callback, ModelCheckpoint, RichProgressBar
from omegaconf import DictConfig

from mops_lightning.config.build import build_as
from mops_lightning.config.shortened import UNLIMITED
from mops_lightning.errors import UserError
from mops_lightning.records.run_record import RunRecord

DEFAULT_CALLBACKS = ("learning_rate", "checkpoint", "progress", "pictures")
"""Names in ``conf/callbacks/default.yaml``. None of them changes the training."""


class CPUTime(Callback):
    """Counts the CPU seconds of the training, with those of the attempts before a resumed one.

    Wall time says little on a machine that does something else as well.
    """

    def __init__(self) -> None:
        self.before = 0.0
        self.start: float | None = None

    @property
    def seconds(self) -> float:
        """CPU seconds of this process and its threads, at the end those of the training."""
        if self.start is None:
            return self.before
        return self.before + time.process_time() - self.start

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Start counting."""
        self.start = time.process_time()

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Stop counting."""
        self.before = self.seconds
        self.start = None

    def state_dict(self) -> dict[str, Any]:
        """Return what a checkpoint keeps."""
        return {"seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue from a checkpoint."""
        self.before = float(state_dict["seconds"])


class KeepsStart(Callback):
    """Keeps in checkpoints what a training began with, for the record of a resumed run.

    A resumed run has its nets from the checkpoint: it loads no task net and starts no layers.
    """

    def __init__(self) -> None:
        self.facts: dict[str, Any] = {}

    def note(self, record: RunRecord) -> None:
        """Take the facts from the record of a training that begins."""
        self.facts = {
            "weights_loaded": record.weights_loaded,
            "warm_start": record.warm_start,
            "partial": list(record.partial),
        }

    def fill(self, record: RunRecord) -> None:
        """Write the facts to the record of a training, which may have begun in another run."""
        for name, value in deepcopy(self.facts).items():
            setattr(record, name, value)

    def state_dict(self) -> dict[str, Any]:
        """Return what a checkpoint keeps."""
        return dict(self.facts)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take the facts of the resumed training."""
        self.facts = dict(state_dict)


class EpochLines(Callback):
    """Prints one line per epoch, for logs and pipes, where a progress bar is noise.

    Args:
        score: the task metric whose validation values are printed.
    """

    def __init__(self, score: str) -> None:
        self.score = score
        self.validated = False

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Note that this epoch has a validation: Lightning keeps the values of the last one."""
        self.validated = not trainer.sanity_checking

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Print the mean loss and the score."""
        validated = self.validated
        self.validated = False
        if not trainer.is_global_zero:
            return
        shown = []
        for name, value in trainer.callback_metrics.items():
            is_score = name.startswith("val/") and name.endswith(f"/{self.score}")
            if name == "train/mean_loss" or (is_score and validated):
                shown.append(f"{name} {float(value):.4f}")
        epoch = f"epoch {trainer.current_epoch + 1}"
        if trainer.max_epochs != UNLIMITED:
            epoch += f"/{trainer.max_epochs}"
        print("  ".join([epoch, *shown]), flush=True)


def last_checkpoint(checkpoint: Path) -> ModelCheckpoint:
    """Return the callback that overwrites one checkpoint after every epoch.

    Args:
        checkpoint: path to write to.
    """
    return ModelCheckpoint(
        dirpath=checkpoint.parent,
        filename=checkpoint.stem,
        save_top_k=1,
        enable_version_counter=False,
        save_on_train_epoch_end=True,
    )


def progress(score: str) -> Callback:
    """Return a progress bar for a terminal, printed lines for anything else.

    Args:
        score: see ``EpochLines``.
    """
    if sys.stdout.isatty():
        return RichProgressBar(leave=False)
    return EpochLines(score)


def build_callbacks(nodes: DictConfig, offered: dict[str, Any], logged: bool) -> list[Callback]:
    """Build the callbacks that a configuration lists.

    Args:
        nodes: by name; null for one that is left out.
        offered: what only the run knows, by argument name. Without a ``batch``, no pictures.
        logged: whether there is a logger for the learning rate.

    Raises:
        UserError: a node describes no callback.
    """
    callbacks = []
    for name, node in nodes.items():
        has_nothing_to_log = name == "learning_rate" and not logged
        has_nothing_to_draw = name == "pictures" and "batch" not in offered
        if node is None or has_nothing_to_log or has_nothing_to_draw:
            continue
        where = f"callbacks.{name!s}"
        if "_target_" not in node:
            raise UserError(f"{where}: give its class as {where}._target_=MODULE.CLASS.")
        callbacks.append(build_as(Callback, node, where, offered))
    return callbacks
