"""Cells of a sweep: finished ones are skipped, failed ones tried again, interrupted ones go on.

A sweep whose folder and cells have fixed names (``hydra.sweep.dir``, ``hydra.sweep.subdir``) may be
started again with the same command at any time.
"""

import fcntl
import logging
import math
import os
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from mops_lightning import records
from mops_lightning.errors import Interrupted, UserError
from mops_lightning.sweep_names import ASIDE, FAILED

STAYS = (ASIDE, ".hydra", ".lock", "cli.log")
"""What belongs to the cell and not to an attempt."""

MAY_DIFFER = ("ckpt_path", "out", "cache", "logger", "pictures")
"""Settings that change where things lie, and no result."""

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
    from mops_lightning.run import STARTED, run

    try:
        with _claimed(folder):
            (folder / FAILED).unlink(missing_ok=True)
            earlier = _earlier(cfg, folder)
            if earlier and earlier["status"] == "completed":
                log.info(f"{folder}: done before, score {earlier['score']:.6g}")
                return float(earlier["score"])
            if earlier:
                checkpoint = _move_aside(folder)
                if checkpoint and earlier["status"] != "failed" and cfg.ckpt_path is None:
                    cfg.ckpt_path = str(checkpoint)
                log.info(
                    f"{folder}: {earlier['status']} before, "
                    + (f"goes on from {cfg.ckpt_path}" if cfg.ckpt_path else "tried again")
                )
            # A process that was killed at its very start left this, and no record.
            (folder / STARTED).unlink(missing_ok=True)
            score = run(cfg, folder, overrides)["score"]
            return math.nan if score is None else float(score)
    except Interrupted:
        raise
    except UserError as error:
        (folder / FAILED).write_text(f"{error}\n")
        log.error(f"{folder} failed: {error}")
    except Exception as error:
        (folder / FAILED).write_text(f"{type(error).__name__}: {error}\n")
        log.exception(f"{folder} failed")
    return math.nan


@contextmanager
def _claimed(folder: Path) -> Iterator[None]:
    """Hold the cell's lock, which goes with the process that has it.

    Raises:
        UserError: another process runs this cell.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UserError("another process runs this cell; let it end, or stop it.") from None
        yield


def _earlier(cfg: DictConfig, folder: Path) -> dict[str, Any] | None:
    """Return the record that lies in the cell's folder.

    Raises:
        UserError: it is of other settings, or is no record.
    """
    if not (folder / records.FILE).exists():
        return None
    record = records.read(folder)
    mine, theirs = OmegaConf.to_container(cfg, resolve=True), record["config"]
    assert isinstance(mine, dict)
    for node in (mine, theirs):
        for key in MAY_DIFFER:
            node.pop(key, None)
    for key, ours, other in _differences(mine, theirs):
        raise UserError(
            f"its result is of other settings: {key} is {ours} now and was {other}. Give the sweep "
            "another folder with hydra.sweep.dir=FOLDER, or move the cell's folder away."
        )
    return record


def _differences(mine: Any, theirs: Any, prefix: str = "") -> Iterator[tuple[str, Any, Any]]:
    if isinstance(mine, dict) and isinstance(theirs, dict):
        for key in {**mine, **theirs}:
            yield from _differences(mine.get(key), theirs.get(key), f"{prefix}{key}.")
    elif mine != theirs:
        yield prefix.rstrip("."), mine, theirs


def _move_aside(folder: Path) -> Path | None:
    """Move an attempt into a numbered folder; return its checkpoint if it has one."""
    from mops_lightning.callbacks import CHECKPOINT

    aside = folder / ASIDE
    target = aside / str(1 + len(list(aside.glob("*"))))
    target.mkdir(parents=True)
    for path in folder.iterdir():
        if path.name not in STAYS:
            path.rename(target / path.name)
    checkpoint = target / "checkpoints" / CHECKPOINT
    return checkpoint if checkpoint.is_file() else None


class SweepSummary(Callback):
    """Says at the end of a sweep what became of its cells; failed ones make the exit status 1."""

    def on_multirun_end(self, config: DictConfig, **extra: Any) -> None:
        """Count the cells below the sweep's folder and print what became of them."""
        folder = Path(os.path.relpath(config.hydra.sweep.dir))
        states: Counter[str] = Counter()
        cells = [*folder.rglob(records.FILE), *folder.rglob(FAILED)]
        for cell in {path.parent for path in cells if ASIDE not in path.parts}:
            failed = (cell / FAILED).exists()
            states["failed" if failed else records.read(cell)["status"]] += 1
        counts = ", ".join(f"{count} {state}" for state, count in sorted(states.items()))
        print(f"{sum(states.values())} cells: {counts}; in {folder}")
        print(f"A table of them: python -m mops_lightning.report {folder}")
        if set(states) != {"completed"}:
            print(f"The same command with hydra.sweep.dir={folder} tries the others again.")
            raise SystemExit(1)
