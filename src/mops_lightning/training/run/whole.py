"""What a run and the training of its task net have in common: a record, and all stages."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mops_lightning.errors import Interrupted, UserError, closed_outputs
from mops_lightning.records import run_record
from mops_lightning.records.run_record import RunRecord
from mops_lightning.training.checkpoint import Diverged
from mops_lightning.training.run import stages
from mops_lightning.training.run.build import Parts
from mops_lightning.training.run.trainer import finish_loggers


def train_and_test(parts: Parts, record: RunRecord, task_weights: Path | None) -> None:
    """Load weights, train the learned parts, test and save them.

    Args:
        parts: of the run.
        record: is filled.
        task_weights: a file for the task net; None leaves it as initialised.
    """
    stages.load_weights(parts, record, task_weights)
    try:
        if parts.trains:
            stages.warm_start(parts, record)
            with record.timed("fit"):
                stages.fit(parts, record)
        with record.timed("test"):
            stages.test(parts, record)
        if parts.trainer.is_global_zero:
            stages.save(parts, record)
    except Diverged as error:
        text = f"{error} No weights were saved."
        if parts.last_checkpoint:
            text += f" The last finite checkpoint is {parts.last_checkpoint}."
        text += " Try a lower learning rate (optimizer.lr) or other weights of the losses."
        raise UserError(text) from None
    finally:
        finish_loggers(parts.trainer)


@contextmanager
def recorded(
    config: dict[str, Any], folder: Path, overrides: list[str], writes: bool = True
) -> Iterator[RunRecord]:
    """Write ``result.json`` when the block begins and when it ends, however it ends.

    Args:
        config: the run's settings as plain data.
        folder: the run's folder.
        overrides: what the user changed.
        writes: whether this process does; of several, only the first one.

    Yields:
        The record, for the block to fill.
    """
    record = RunRecord.begin(config, overrides, config["seed"])
    if writes:
        run_record.write(folder, record)
    try:
        with record.timed("total"):
            yield record
        record.status = "completed"
    except (KeyboardInterrupt, Interrupted) as stop:
        record.status = "interrupted"
        record.error = str(stop) or "interrupted"
        raise
    except BaseException as error:
        has_no_reader = isinstance(error, BrokenPipeError) and closed_outputs()
        record.status = "interrupted" if has_no_reader else "failed"
        record.error = f"{type(error).__name__}: {error}"
        raise
    finally:
        if writes:
            run_record.write(folder, record)
