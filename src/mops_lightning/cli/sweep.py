"""Runs of a sweep: completed ones are skipped, failed ones repeated, interrupted ones resumed.

A sweep whose folders have fixed names (``hydra.sweep.dir``, ``hydra.sweep.subdir``) can be started
again with the same command at any time.
"""

import logging
import math
import os
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from mops_lightning.cli.start import line_about_run
from mops_lightning.config import settings
from mops_lightning.config.settings import Affects
from mops_lightning.errors import (
    USER_ERROR,
    Interrupted,
    UserError,
    as_line,
    end,
    one_line,
    one_line_endings,
)
from mops_lightning.filesystem import remove_temporary
from mops_lightning.records import run_record
from mops_lightning.records.run_record import ASIDE, FAILED, RunRecord

BEGUN = ".begun"
"""File in a sweep's folder with the time of its last start."""

MOVING = "moving"
"""Folder of an attempt that is being moved."""

STAYS = (ASIDE, ".hydra", ".lock", "mops_lightning.log")
"""Files that belong to the cell, not to an attempt."""

ELSEWHERE = "left to another process"
"""State of a cell that another process runs."""

log = logging.getLogger(__name__)


def run_cell(cfg: DictConfig, folder: Path, overrides: list[str]) -> float:
    """Run one cell of a sweep, unless an earlier start of the sweep completed it.

    Args:
        cfg: the cell's configuration.
        folder: the cell's folder.
        overrides: of the sweep and the user, for the record.

    Returns:
        The score. NaN if the cell failed, so that the sweep continues; the record and the log say
        why.

    Raises:
        Interrupted: the user stopped the sweep.
    """
    from mops_lightning.training.run.run import STARTED, checked, claim, run

    try:
        with _lock(folder):
            (folder / FAILED).unlink(missing_ok=True)
            remove_temporary(folder)
            if (folder / ASIDE / MOVING).is_dir():
                _move_aside(folder)  # an earlier start was killed in the middle of it
            cfg = checked(cfg, overrides)  # an evaluation has the settings of its run
            earlier = _earlier(cfg, folder)
            status, score = earlier or ("killed", math.nan)
            if status == "completed":
                log.info(f"{folder}: already completed, score {score:.6g}")
                return score
            if earlier:
                _move_aside(folder)
            if (folder / ASIDE).is_dir():
                checkpoint = _checkpoint(cfg, folder)
                if checkpoint and cfg.ckpt_path is None:
                    cfg.ckpt_path = str(checkpoint)
                action = f"resuming from {cfg.ckpt_path}" if cfg.ckpt_path else "starting again"
                log.info(f"{folder}: the last attempt was {status}; {action}")
            # A process that was killed before it wrote a record left this file.
            (folder / STARTED).unlink(missing_ok=True)
            claim(folder)
            new = run(cfg, folder, overrides, claimed=True).score
            return math.nan if new is None else float(new)
    except (Interrupted, BrokenPipeError):
        raise
    except Timeout:
        log.warning(f"{folder}: skipped, because another process runs this cell")
    except Exception as error:
        text = line_about_run(error, overrides)
        if text is None:
            log.exception(f"{folder} failed")
        else:
            log.error(as_line(f"{folder} failed: {text}"))
        with suppress(OSError):  # the disk may be full
            (folder / FAILED).write_text(f"{text or one_line(error)}\n")
    return math.nan


def _lock(folder: Path) -> FileLock:
    """Return the cell's lock, which raises ``Timeout`` where another process runs the cell.

    A killed process releases it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    return FileLock(folder / ".lock", timeout=0)


def _earlier(cfg: DictConfig, folder: Path) -> tuple[str, float] | None:
    """Return status and score of the record in the cell's folder.

    Raises:
        UserError: it is damaged, or has other settings.
    """
    if not (folder / run_record.FILE).exists():
        return None
    record = run_record.read(folder)
    different = _differences(cfg, record)
    if different:
        # The setting itself, not one that is derived from it.
        key = min(different, key=lambda one: (one.count("."), one))
        ours, other = different[key]
        raise UserError(
            f"its result has other settings: {key} was {other}, got {ours}. Give the sweep another "
            f"folder with hydra.sweep.dir=FOLDER; if {key} is swept, add it to hydra.sweep.subdir; "
            "or move the cell's folder away."
        )
    return record.status, math.nan if record.score is None else record.score


def _differences(cfg: DictConfig, record: RunRecord) -> dict[str, tuple[Any, Any]]:
    """Return the dotted settings that differ but must not: the present and the earlier value."""
    mine = run_record.dotted(OmegaConf.to_container(cfg, resolve=True))
    theirs = run_record.dotted(record.config)
    return {
        key: (mine.get(key), theirs.get(key))
        for key in {**mine, **theirs}
        if mine.get(key) != theirs.get(key) and settings.of(key).affects is not Affects.NOTHING
    }


def _checkpoint(cfg: DictConfig, folder: Path) -> Path | None:
    """Return the checkpoint of the newest attempt that has one.

    Neither a failed attempt nor any attempt before it is resumed.
    """
    from mops_lightning.training.checkpoint import CHECKPOINT

    for attempt in sorted(_attempts(folder), key=lambda path: int(path.name), reverse=True):
        try:
            record = run_record.read(attempt)
        except UserError:
            continue  # its checkpoint may belong to other settings
        if record.status == "failed" or _differences(cfg, record):
            return None
        path = attempt / "checkpoints" / CHECKPOINT
        if path.is_file():
            return path
    return None


def _attempts(folder: Path) -> list[Path]:
    return [path for path in (folder / ASIDE).glob("*") if path.name.isdigit()]


def _move_aside(folder: Path) -> None:
    """Move an attempt into a numbered folder.

    The number is given in one step at the end, and until then ``MOVING`` shows that it is to be
    done. The record is moved last, so that a repeated call completes what a killed one began.
    """
    moving = folder / ASIDE / MOVING
    moving.mkdir(parents=True, exist_ok=True)
    paths = [path for path in folder.iterdir() if path.name not in STAYS]
    for path in sorted(paths, key=lambda path: path.name == run_record.FILE):
        path.rename(moving / path.name)
    numbers = [int(path.name) for path in _attempts(folder)]
    moving.rename(folder / ASIDE / str(max(numbers, default=0) + 1))


def _state(cell: Path) -> str:
    try:
        with _lock(cell):
            pass
    except Timeout:
        return ELSEWHERE
    if (cell / FAILED).exists():
        return "failed"
    try:
        return run_record.read(cell).status
    except UserError:
        return "not started"


def _add_models(cells: list[Path], folder: Path) -> None:
    """Write the nets that cells trained as models in ``models/`` of the sweep's folder."""
    from mops_lightning.zoo import publish

    added = publish.add_all(cells, folder, folder / "models")
    if added:
        place = folder / "models"
        print(f"{len(added)} models in {place}; to test one:")
        print(f"MOPS_MODELS={place} python -m mops_lightning evaluate={added[-1].stem}")


class SweepSummary(Callback):
    """Counts the cells at the end of a sweep and reports them; the exit status is 1 if any failed.

    The report is that of the whole folder, so that earlier starts and the other processes of the
    same sweep count too.

    Args:
        mixed: whether the report joins runs that differ in settings which the sweep does not vary
            for comparison, such as epochs chosen for each size.
        models: whether the nets that were trained become models with cards, in ``models/`` of the
            sweep's folder.
    """

    def __init__(self, mixed: bool = False, models: bool = False) -> None:
        self.mixed = mixed
        self.models = models

    def on_multirun_start(self, config: DictConfig, **extra: Any) -> None:
        """Mark the start, on the clock of the folder's file system."""
        folder = Path(config.hydra.sweep.dir)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / BEGUN).touch()
        except OSError as error:
            end("mops_lightning", f"out: cannot write to {folder}: {error.strerror}.", USER_ERROR)

    def on_multirun_end(self, config: DictConfig, **extra: Any) -> None:
        """Count the cells of this start by state, and write the report.

        Raises:
            SystemExit: with 1 if a cell failed or the report did. Hydra turns any other exception
                of a callback into a warning, and ends with 0.
        """
        folder = Path(os.path.relpath(config.hydra.sweep.dir))
        try:
            with one_line_endings("mops_lightning"):
                states = self._states(folder)
                self._report(folder, states)
        except Exception:
            log.exception("the runs are done, but the end of the sweep failed")
            raise SystemExit(1) from None
        found = set(states.values())
        if found - {"completed", ELSEWHERE} or not found:
            print(f"To repeat the rest: the same command with hydra.sweep.dir={folder}")
            raise SystemExit(1)

    def _states(self, folder: Path) -> dict[Path, str]:
        """Return the states of the cells of this start, and print their numbers."""
        begun = (folder / BEGUN).stat().st_mtime_ns
        states: dict[Path, str] = {}
        # Hydra writes this into every cell that it starts.
        for path in folder.rglob(".hydra/overrides.yaml"):
            cell = path.parents[1]
            if path.stat().st_mtime_ns >= begun:
                states[cell] = _state(cell)
        numbers = sorted(Counter(states.values()).items())
        counts = ", ".join(f"{count} {state}" for state, count in numbers) or "no values to sweep"
        print(f"{len(states)} cells: {counts}; in {folder}")
        return states

    def _report(self, folder: Path, states: dict[Path, str]) -> None:
        """Write the report of all cells below a folder, and the models of this start's cells."""
        from mops_lightning.report import cli as report

        completed = [cell for cell, state in states.items() if state == "completed"]
        if completed:
            options = ["--mixed"] if self.mixed else []
            report.main([str(folder), *options], "python -m mops_lightning report")
        if self.models:
            _add_models(completed, folder)
