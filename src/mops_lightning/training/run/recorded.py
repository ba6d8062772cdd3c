"""The record of a run or of its task net's training, written also when the run fails."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mops_lightning.errors import Interrupted, closed_outputs
from mops_lightning.records import run_record
from mops_lightning.records.run_record import RunRecord


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
        record.status = "failed"
        has_no_reader = isinstance(error, BrokenPipeError) and closed_outputs()
        if has_no_reader:
            record.status = "interrupted"
        record.error = f"{type(error).__name__}: {error}"
        raise
    finally:
        if writes:
            run_record.write(folder, record)
