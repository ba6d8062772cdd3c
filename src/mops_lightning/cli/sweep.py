"""Cells of a sweep: finished ones are skipped, failed ones tried again, interrupted ones go on.

A sweep whose folder and cells have fixed names (``hydra.sweep.dir``, ``hydra.sweep.subdir``) may be
started again with the same command at any time.
"""

import logging
import math
import os
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from mops_lightning.config import settings
from mops_lightning.config.declaration import Affects
from mops_lightning.errors import Interrupted, UserError
from mops_lightning.records import run_record
from mops_lightning.records.attempts import ASIDE, FAILED

BEGUN = ".begun"
"""File in a sweep's folder that is as old as its last start."""

STAYS = (ASIDE, ".hydra", ".lock", "cli.log")
"""What belongs to the cell and not to an attempt."""

log = logging.getLogger(__name__)


def run_cell(cfg: DictConfig, folder: Path, overrides: list[str]) -> float:
    """Run one cell of a sweep, as far as no earlier start of the sweep has.

    Args:
        cfg: the cell's configuration.
        folder: the cell's folder.
        overrides: what the sweep and the user changed, for the record.

    Returns:
        The score; not a number when the cell failed, which its record and the log explain, so that
        the other cells are run all the same.

    Raises:
        Interrupted: the user stopped the sweep.
    """
    from mops_lightning.training.run import STARTED, run

    try:
        with _claimed(folder):
            (folder / FAILED).unlink(missing_ok=True)
            earlier = _earlier(cfg, folder)
            if earlier and earlier["status"] == "completed":
                log.info(f"{folder}: done before, score {earlier['score']:.6g}")
                return float(earlier["score"])
            if earlier:
                _move_aside(folder)
            if (folder / ASIDE).is_dir():
                checkpoint = _checkpoint(cfg, folder)
                if checkpoint and cfg.ckpt_path is None:
                    cfg.ckpt_path = str(checkpoint)
                goes_on = f"goes on from {cfg.ckpt_path}" if cfg.ckpt_path else "tried again"
                log.info(
                    f"{folder}: {earlier['status'] if earlier else 'cut off'} before, {goes_on}"
                )
            # A process that was killed at its very start left this, and no record.
            (folder / STARTED).unlink(missing_ok=True)
            score = run(cfg, folder, overrides).score
            return math.nan if score is None else float(score)
    except Interrupted:
        raise
    except Busy:
        log.warning(f"{folder}: another process runs this cell, and it is left to it")
    except UserError as error:
        (folder / FAILED).write_text(f"{error}\n")
        log.error(f"{folder} failed: {error}")
    except Exception as error:
        (folder / FAILED).write_text(f"{type(error).__name__}: {error}\n")
        log.exception(f"{folder} failed")
    return math.nan


@contextmanager
def _claimed(folder: Path) -> Iterator[None]:
    """Hold the cell's lock; a killed process releases it.

    Raises:
        Busy: another process runs this cell.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / ".lock")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise Busy from None
    try:
        yield
    finally:
        lock.release()


def _earlier(cfg: DictConfig, folder: Path) -> dict[str, Any] | None:
    """Return the record that lies in the cell's folder.

    Raises:
        UserError: it is of other settings, or is no record.
    """
    if not (folder / run_record.FILE).exists():
        return None
    record = run_record.read(folder)
    different = _differences(cfg, record)
    if different:
        # The setting itself, not one of those that are derived from it.
        key = min(different, key=lambda one: (one.count("."), one))
        ours, other = different[key]
        raise UserError(
            f"its result is of other settings: {key} is {ours} now and was {other}. Give the sweep "
            f"another folder with hydra.sweep.dir=FOLDER; where {key} is swept, name the cells by "
            "it too, with hydra.sweep.subdir; or move the cell's folder away."
        )
    return record


def _differences(cfg: DictConfig, record: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Return the dotted settings that differ and may not: what they are now, and were."""
    mine = run_record.dotted(OmegaConf.to_container(cfg, resolve=True))
    theirs = run_record.dotted(record["config"])
    return {
        key: (mine.get(key), theirs.get(key))
        for key in {**mine, **theirs}
        if mine.get(key) != theirs.get(key) and settings.of(key).affects is not Affects.NOTHING
    }


def _checkpoint(cfg: DictConfig, folder: Path) -> Path | None:
    """Return the checkpoint of the newest attempt with one: the last may have been cut off early.

    An attempt that failed by itself is no place to go on from, nor what lies before it.
    """
    from mops_lightning.training.callbacks import CHECKPOINT

    attempts = (folder / ASIDE).iterdir()
    for attempt in sorted(attempts, key=lambda path: int(path.name), reverse=True):
        record = run_record.read(attempt)
        if record["status"] == "failed" or _differences(cfg, record):
            return None
        if (attempt / "checkpoints" / CHECKPOINT).is_file():
            return attempt / "checkpoints" / CHECKPOINT
    return None


def _move_aside(folder: Path) -> None:
    """Move an attempt into a numbered folder."""
    aside = folder / ASIDE
    target = aside / str(1 + len(list(aside.glob("*"))))
    target.mkdir(parents=True)
    for path in folder.iterdir():
        if path.name not in STAYS:
            path.rename(target / path.name)


class Busy(Exception):
    """Another process runs a cell."""


def _state(cell: Path) -> str:
    if (cell / FAILED).exists():
        return "failed"
    try:
        return str(run_record.read(cell)["status"])
    except UserError:
        return "not begun"


class SweepSummary(Callback):
    """Says at the end of a sweep what became of its cells; failed ones make the exit status 1."""

    def on_multirun_start(self, config: DictConfig, **extra: Any) -> None:
        """Mark the beginning, on the clock of the folder's own disk."""
        folder = Path(config.hydra.sweep.dir)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / BEGUN).touch()

    def on_multirun_end(self, config: DictConfig, **extra: Any) -> None:
        """Count the cells of this start and print what became of them."""
        folder = Path(os.path.relpath(config.hydra.sweep.dir))
        begun = (folder / BEGUN).stat().st_mtime_ns
        states: Counter[str] = Counter()
        # Hydra writes this into every cell that it starts.
        for path in folder.rglob(".hydra/overrides.yaml"):
            cell = path.parents[1]
            if path.stat().st_mtime_ns >= begun:
                states[_state(cell)] += 1
        counts = ", ".join(f"{count} {state}" for state, count in sorted(states.items()))
        print(f"{sum(states.values())} cells: {counts}; in {folder}")
        print(f"A table of them: python -m mops_lightning.report {folder}")
        if set(states) != {"completed"}:
            print(f"The same command with hydra.sweep.dir={folder} tries the others again.")
            raise SystemExit(1)
