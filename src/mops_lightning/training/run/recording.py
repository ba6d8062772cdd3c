"""Keeping ``result.json`` up to date while a run is under way."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from mops_lightning.config import distributed
from mops_lightning.errors import Interrupted, closed_outputs
from mops_lightning.records import run_record
from mops_lightning.records.run_record import RunRecord


@contextmanager
def recorded(cfg: DictConfig, folder: Path, overrides: list[str]) -> Iterator[RunRecord]:
    """Write ``result.json`` when the block begins and when it ends, however it ends.

    Only the first process of a run writes.

    Args:
        cfg: a composed configuration.
        folder: the run's folder.
        overrides: what the user changed.

    Yields:
        The record, for the block to fill.
    """
    config: Any = OmegaConf.to_container(cfg, resolve=True)
    record = RunRecord.begin(config, overrides, cfg.seed)
    writes = not distributed.is_worker_rank(cfg)

    if writes:
        run_record.write(folder, record)
    try:
        with record.timed("total"):
            yield record
        record.status = "completed"
    except (KeyboardInterrupt, Interrupted) as stop:
        record.status, record.error = "interrupted", str(stop) or "interrupted"
        raise
    except BaseException as error:
        stopped = isinstance(error, BrokenPipeError) and closed_outputs()
        record.status = "interrupted" if stopped else "failed"
        record.error = f"{type(error).__name__}: {error}"
        raise
    finally:
        if writes:
            run_record.write(folder, record)
