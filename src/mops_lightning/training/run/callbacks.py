"""Lightning callbacks of a run: checkpoints, clean stops, progress."""

import signal
import sys
import time
from pathlib import Path
from types import FrameType
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import Callback, Checkpoint, ModelCheckpoint, RichProgressBar
from omegaconf import DictConfig

from mops_lightning.config.build import accepted, build_as
from mops_lightning.errors import Interrupted, UserError

STANDARD = ("learning_rate", "checkpoint", "progress", "pictures")
"""Names in ``conf/callbacks/default.yaml``. None of them changes the training."""


class StopBetweenSteps(Checkpoint):
    """On the first Ctrl-C or SIGTERM, finish the step, write a checkpoint and stop.

    A signal may arrive inside an optimizer step. The state is consistent between steps only, and
    only then does resuming give the result of an uninterrupted run. After the last step of an
    epoch, the epoch's validation is finished first. A second signal stops at once.

    As a ``Checkpoint``, it is called after the callbacks that act at the end of an epoch.

    Args:
        checkpoint: path to write to.
    """

    def __init__(self, checkpoint: Path) -> None:
        self.checkpoint = checkpoint
        self.received: int | None = None
        self.leads = True
        self._before: dict[int, Any] = {}

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Install the signal handlers, after Lightning has set its own."""
        self.leads = trainer.is_global_zero
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._note)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.received is not None:
            raise KeyboardInterrupt("Stopped at once; the last complete checkpoint is kept.")
        self.received = number
        if self.leads:
            print("Stopping after this step (once more: at once) ...", file=sys.stderr, flush=True)

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Stop if a signal came, all processes of a run after the same optimizer step."""
        batches = batch_idx + 1
        stepped = batches % trainer.accumulate_grad_batches == 0
        if stepped and batches < trainer.num_training_batches:
            self._stop_if_asked(trainer, save=True)

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Stop if a signal came in the last step of the epoch or in its validation."""
        self._stop_if_asked(trainer, save=True)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Restore the signal handlers; stop if a signal came in the last step."""
        self._restore()
        self._stop_if_asked(trainer, save=False)

    def _stop_if_asked(self, trainer: L.Trainer, save: bool) -> None:
        if trainer.strategy.reduce_boolean_decision(self.received is not None, all=False):
            if save:
                trainer.save_checkpoint(self.checkpoint)
            raise Interrupted(f"Resume with the same command and ckpt_path={self.checkpoint}")

    def on_exception(self, trainer: L.Trainer, *args: Any) -> None:
        """Restore the signal handlers."""
        self._restore()

    def _restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before.clear()


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
        since = 0.0 if self.start is None else time.process_time() - self.start
        return self.before + since

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Start counting."""
        self.start = time.process_time()

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Stop counting."""
        self.before, self.start = self.seconds, None

    def state_dict(self) -> dict[str, Any]:
        """Return what a checkpoint keeps."""
        return {"seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue from a checkpoint."""
        self.before = float(state_dict["seconds"])


class EpochLines(Callback):
    """Prints one line per epoch, for logs and pipes, where a progress bar is noise.

    Args:
        score: the task metric whose validation values are printed.
    """

    def __init__(self, score: str) -> None:
        self.score = score

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Print the mean loss and the score."""
        if not trainer.is_global_zero:
            return
        numbers = {
            name: float(value)
            for name, value in trainer.callback_metrics.items()
            if name == "train/mean_loss"
            or (name.startswith("val/") and name.endswith(f"/{self.score}"))
        }
        shown = "  ".join(f"{name} {value:.4f}" for name, value in numbers.items())
        print(f"epoch {trainer.current_epoch + 1}/{trainer.max_epochs}  {shown}", flush=True)


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
    return RichProgressBar(leave=False) if sys.stdout.isatty() else EpochLines(score)


def build_callbacks(nodes: DictConfig, offered: dict[str, Any], logged: bool) -> list[Callback]:
    """Build the callbacks that a configuration lists.

    Args:
        nodes: by name; null for one that is left out.
        offered: what only the run knows, by argument name. Without a ``batch``, no pictures.
        logged: whether there is a logger for the learning rate.

    Raises:
        UserError: a node describes no callback.
    """
    chosen = {str(name): node for name, node in nodes.items() if node is not None}
    if not logged:
        chosen.pop("learning_rate", None)
    if "batch" not in offered:
        chosen.pop("pictures", None)
    built = []
    for name, node in chosen.items():
        where = f"callbacks.{name}"
        if "_target_" not in node:
            raise UserError(f"{where}: give its class as {where}._target_=MODULE.CLASS.")
        built.append(build_as(Callback, node, where, **accepted(node, offered)))
    return built
