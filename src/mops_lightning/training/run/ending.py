"""How a training ends: on a signal, between steps; and that it has ended, kept in checkpoints."""

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

import lightning as L
from lightning.pytorch.callbacks import Callback, Checkpoint

from mops_lightning.errors import Interrupted
from mops_lightning.training.checkpoint import ENDING, Ending


class StopBetweenSteps(Callback):
    """On the first Ctrl-C or SIGTERM, finish the step and stop.

    A signal may arrive inside an optimizer step. The state is consistent between steps only, and
    only then does resuming give the result of an uninterrupted run. After the last step of an
    epoch, the epoch's validation is finished first. A second signal stops at once.

    Args:
        checkpoint: path of a checkpoint to write first; None: none is written.
    """

    def __init__(self, checkpoint: Path | None) -> None:
        self.checkpoint = checkpoint
        self.received: int | None = None  # number of the first signal
        self.prints = True
        self._before: dict[int, Any] = {}

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Install the signal handlers, after Lightning has set its own."""
        self.prints = trainer.is_global_zero
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._note)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.received is not None:
            raise KeyboardInterrupt("Stopped at once; the last complete checkpoint is kept.")
        self.received = number
        if self.prints:
            print("Stopping after this step (once more: at once) ...", file=sys.stderr, flush=True)

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Stop if a signal came, all processes of a run after the same optimizer step."""
        batches = batch_idx + 1
        is_after_step = batches % trainer.accumulate_grad_batches == 0
        is_last = batches >= trainer.num_training_batches
        if is_after_step and not is_last:
            self._stop_if_asked(trainer, save=True)

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Stop if a signal came in the last step of the epoch or in its validation."""
        self._stop_if_asked(trainer, save=True)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Restore the signal handlers; stop if a signal came in the last step."""
        self._restore()
        self._stop_if_asked(trainer, save=False)

    def _stop_if_asked(self, trainer: L.Trainer, save: bool) -> None:
        is_asked = trainer.strategy.reduce_boolean_decision(self.received is not None, all=False)
        if not is_asked:
            return
        if self.checkpoint is None:
            raise Interrupted("No checkpoint was written.")
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


class StopWithCheckpoint(StopBetweenSteps, Checkpoint):
    """Writes a checkpoint before it stops.

    As a ``Checkpoint``, it is called after the callbacks that act at the end of an epoch. Lightning
    refuses one with ``enable_checkpointing=false``.
    """


class KeepsEnding(Callback):
    """Keeps in checkpoints whether training was told to stop, and its last validation.

    Early stopping, a time limit and any other callback end training by ``trainer.should_stop``,
    which Lightning does not save: a resumed run would train on.
    """

    def __init__(self) -> None:
        self.restored: Ending | None = None

    def on_save_checkpoint(
        self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Add the state to a checkpoint."""
        ending = Ending(bool(trainer.should_stop), self.validation(trainer))
        checkpoint[ENDING] = ending.plain()

    def on_load_checkpoint(
        self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Read the state from a checkpoint."""
        self.restored = Ending.of(checkpoint)

    def on_fit_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Tell the resumed training to stop if the saved one was."""
        if self.restored is not None and self.restored.should_stop:
            trainer.should_stop = True

    def validation(self, trainer: L.Trainer) -> dict[str, float]:
        """Return the metrics of the last validation, which may have been before a stop."""
        validation = {}
        for name, value in trainer.callback_metrics.items():
            if name.startswith("val/"):
                validation[name] = float(value)
        if validation or self.restored is None:
            return validation
        return self.restored.validation


@contextmanager
def sigterm_as_ctrl_c() -> Iterator[None]:
    """Let SIGTERM interrupt as Ctrl-C does, wherever a run is.

    Python's own reaction ends the process without a word in its record. Lightning's waits for the
    next batch of a test, which after the last batch never comes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # signals reach the main thread only
        return
    before = signal.signal(signal.SIGTERM, _interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt
