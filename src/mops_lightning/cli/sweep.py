"""Runs of a sweep: completed ones are skipped, failed ones repeated, interrupted ones resumed.

A sweep whose folders have fixed names (``hydra.sweep.dir``, ``hydra.sweep.subdir``) can be started
again with the same command at any time.
"""

import logging
import math
from contextlib import suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from omegaconf import DictConfig, OmegaConf

from mops_lightning.cli.start import line_about_run
from mops_lightning.config import settings
from mops_lightning.config.declaration import Affects
from mops_lightning.errors import Interrupted, UserError, as_line, one_line
from mops_lightning.filesystem import remove_temporary
from mops_lightning.records import run_record
from mops_lightning.records.run_record import ASIDE, FAILED, RunRecord
from mops_lightning.tree import dotted

MOVING = "moving"
"""Folder of an attempt that is being moved."""

STAYS = (ASIDE, ".hydra", ".lock", "mops_lightning.log")
"""Files that belong to the cell, not to an attempt."""

log = logging.getLogger(__name__)


def run_cell(cfg: DictConfig, folder: Path, overrides: list[str]) -> float:
    """Run one cell of a sweep, unless an earlier start of the sweep completed it.

    Args:
        cfg: the cell's configuration.
        folder: the cell's folder.
        overrides: what the sweep and the user changed, for the record.

    Returns:
        The score. NaN if the cell failed, so that the sweep continues; the record and the log say
        why.

    Raises:
        Interrupted: the user stopped the sweep.
    """
    try:
        with lock(folder):
            return _run_or_repeat(cfg, folder, overrides)
    except (Interrupted, BrokenPipeError):
        raise
    except Timeout:
        log.warning(f"{folder}: skipped, because another process runs this cell")
    except Exception as error:
        _note_failure(error, folder, overrides)
    return math.nan


def _run_or_repeat(cfg: DictConfig, folder: Path, overrides: list[str]) -> float:
    """Run a cell whose folder is locked, unless it is completed, and return its score."""
    from mops_lightning.training.run.run import STARTED, checked, claim, run_in

    (folder / FAILED).unlink(missing_ok=True)
    remove_temporary(folder)
    if (folder / ASIDE / MOVING).is_dir():
        _move_aside(folder)  # an earlier start was killed in the middle of it
    cfg = checked(cfg, overrides)  # an evaluation has the settings of its run
    status = "killed"
    earlier = _earlier(cfg, folder)
    if earlier is not None:
        if earlier.status == "completed":
            score = _number(earlier.score)
            log.info(f"{folder}: already completed, score {score:.6g}")
            return score
        status = earlier.status
        _move_aside(folder)
    if (folder / ASIDE).is_dir():
        checkpoint = _checkpoint(cfg, folder)
        if checkpoint and cfg.ckpt_path is None:
            cfg.ckpt_path = str(checkpoint)
        action = "starting again"
        if cfg.ckpt_path:
            action = f"resuming from {cfg.ckpt_path}"
        log.info(f"{folder}: the last attempt was {status}; {action}")
    # A process that was killed before it wrote a record left this file.
    (folder / STARTED).unlink(missing_ok=True)
    claim(folder)
    return _number(run_in(folder, cfg, overrides).score)


def _number(score: float | None) -> float:
    """Return a score, NaN for none."""
    if score is None:
        return math.nan
    return float(score)


def _note_failure(error: Exception, folder: Path, overrides: list[str]) -> None:
    """Say in the log and in the cell's folder why the cell failed."""
    text = line_about_run(error, overrides)
    if text is None:
        log.exception(f"{folder} failed")
        text = one_line(error)
    else:
        log.error(as_line(f"{folder} failed: {text}"))
    with suppress(OSError):  # the disk may be full
        (folder / FAILED).write_text(f"{text}\n")


def lock(folder: Path) -> FileLock:
    """Return the cell's lock, which raises ``Timeout`` where another process runs the cell.

    A killed process releases it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    return FileLock(folder / ".lock", timeout=0)


def _earlier(cfg: DictConfig, folder: Path) -> RunRecord | None:
    """Return the record in the cell's folder.

    Raises:
        UserError: it is damaged, or has other settings.
    """
    if not (folder / run_record.FILE).exists():
        return None
    record = run_record.read(folder)
    different = _differences(cfg, record)
    if different:
        # The setting itself, not one that is derived from it.
        key = min(different, key=lambda path: (path.count("."), path))
        present, recorded = different[key]
        raise UserError(
            f"its result has other settings: {key} was {recorded}, got {present}. "
            f"Give the sweep another folder with hydra.sweep.dir=FOLDER; if {key} is swept, "
            "add it to hydra.sweep.subdir; or move the cell's folder away."
        )
    return record


def _differences(cfg: DictConfig, record: RunRecord) -> dict[str, tuple[Any, Any]]:
    """Return the dotted settings that differ but must not: the present and the earlier value."""
    present = dotted(OmegaConf.to_container(cfg, resolve=True))
    recorded = dotted(record.config)
    different = {}
    for key in {**present, **recorded}:
        value = present.get(key)
        earlier = recorded.get(key)
        affects_results = settings.of(key).affects is not Affects.NOTHING
        if value != earlier and affects_results:
            different[key] = (value, earlier)
    return different


def _checkpoint(cfg: DictConfig, folder: Path) -> Path | None:
    """Return the checkpoint of the newest attempt that has one.

    Neither a failed attempt nor any attempt before it is resumed.
    """
    from mops_lightning.training.checkpoint import CHECKPOINT

    for attempt in sorted(_attempts(folder), key=_attempt_number, reverse=True):
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


def _attempt_number(path: Path) -> int:
    return int(path.name)


def _order_of_moving(name: str) -> tuple[bool, str]:
    """Return a key that sorts names of files, with the record at the end."""
    return name == run_record.FILE, name


def _move_aside(folder: Path) -> None:
    """Move an attempt into a numbered folder.

    The number is given in one step at the end, and until then ``MOVING`` shows that it is to be
    done. The record is moved last, so that a repeated call completes what a killed one began.
    """
    moving = folder / ASIDE / MOVING
    moving.mkdir(parents=True, exist_ok=True)
    names = [path.name for path in folder.iterdir() if path.name not in STAYS]
    for name in sorted(names, key=_order_of_moving):
        (folder / name).rename(moving / name)
    numbers = [_attempt_number(path) for path in _attempts(folder)]
    number = max(numbers, default=0) + 1
    moving.rename(folder / ASIDE / str(number))
