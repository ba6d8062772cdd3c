"""The start and the end of a sweep: its cells are counted, reported, and made into models."""

import logging
import os
from collections import Counter
from pathlib import Path
from typing import Any

from filelock import Timeout
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, open_dict

from mops_lightning.cli.sweep import lock
from mops_lightning.errors import USER_ERROR, UserError, end, one_line_endings
from mops_lightning.records import run_record
from mops_lightning.records.run_record import FAILED

BEGUN = ".begun"
"""File in a sweep's folder with the time of its last start."""

ELSEWHERE = "left to another process"
"""State of a cell that another process runs."""

log = logging.getLogger(__name__)


def _state(cell: Path) -> str:
    try:
        with lock(cell):
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

    models = folder / "models"
    added = publish.add_all(cells, folder, models)
    if added:
        print(f"{len(added)} models in {models}; to test one:")
        print(f"MOPS_MODELS={models} python -m mops_lightning evaluate={added[-1].stem}")


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
        _let_search_go_on(config)

    def on_multirun_end(self, config: DictConfig, **extra: Any) -> None:
        """Count the cells of this start by state, and write the report.

        Raises:
            SystemExit: with 1 if a cell failed or the report did, with the status of a user's error
                if the report refuses the runs. Hydra turns any other exception of a callback into
                a warning, and ends with 0.
        """
        folder = Path(os.path.relpath(config.hydra.sweep.dir))
        try:
            with one_line_endings("mops_lightning"):
                states = self._states(folder)
                self._report(folder, states)
        except Exception:
            log.exception("the runs are done, but the end of the sweep failed")
            raise SystemExit(1) from None
        different_states = set(states.values())
        has_unfinished = bool(different_states - {"completed", ELSEWHERE})
        if has_unfinished or not states:
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
        texts = [f"{count} {state}" for state, count in numbers]
        counts = ", ".join(texts) or "no values to sweep"
        print(f"{len(states)} cells: {counts}; in {folder}")
        return states

    def _report(self, folder: Path, states: dict[Path, str]) -> None:
        """Write the report of all cells below a folder, and the models of this start's cells."""
        from mops_lightning.report import cli as report

        completed = [cell for cell, state in states.items() if state == "completed"]
        if completed:
            arguments = [str(folder)]
            if self.mixed:
                arguments.append("--mixed")
            report.main(arguments, "python -m mops_lightning report")
        if self.models:
            _add_models(completed, folder)


def _let_search_go_on(config: DictConfig) -> None:
    """Let a search by Optuna survive failed trials, unless its user limits their share."""
    sweeper = config.hydra.sweeper
    limit = "hydra.sweeper.max_failure_rate"
    is_given = any(str(override).startswith(limit) for override in config.hydra.overrides.hydra)
    if "max_failure_rate" in sweeper and not is_given:
        with open_dict(sweeper):
            sweeper.max_failure_rate = 1.0
