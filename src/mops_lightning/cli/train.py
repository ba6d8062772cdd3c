"""Training from the command line: one run, or a sweep, composed by Hydra."""

import argparse
import math
import os
import sys
import traceback
from pathlib import Path
from typing import TYPE_CHECKING

from mops_lightning import errors
from mops_lightning.config.check_overrides import check_overrides
from mops_lightning.config.explain import explain
from mops_lightning.config.groups import conf_dir
from mops_lightning.config.overrides import as_typed, key, readable, with_home, with_own_classes

if TYPE_CHECKING:
    from omegaconf import DictConfig

NAME = "mops_lightning"
"""Prefix of error messages."""

ONE_LINE_FROM = ("hydra.", "optuna.")
"""Packages whose ValueErrors are mistakes, such as flags that exclude each other."""

NO_OPTIMISERS = (
    "hydra._internal.core_plugins.basic_sweeper.BasicSweeper",
    "hydra_plugins.grid_sweeper.GridSweeper",
)
"""Sweepers that do not read scores, and end at the first exception of a job."""


def main() -> None:
    """Run one job or a sweep; a user's mistake ends in one line and exit status 2."""
    try:
        _run()
    except (KeyboardInterrupt, errors.Interrupted) as stop:
        errors.end(NAME, f"interrupted. {stop}".rstrip(), errors.INTERRUPTED)


def _run() -> None:
    import hydra
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError  # type: ignore[import-untyped]

    show_traceback = bool(os.environ.get("HYDRA_FULL_ERROR"))
    # Makes Hydra raise instead of printing its own shortened traceback.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        sys.argv[1:] = _for_hydra(sys.argv[1:])
        app = hydra.main(config_path=str(conf_dir()), config_name="config", version_base="1.3")
        app(_job)()
    except Exception as error:
        if show_traceback:
            raise
        of_hydra = HydraException | OmegaConfBaseException | YAMLError | UnicodeDecodeError
        if isinstance(error, of_hydra):
            errors.end(NAME, explain(error, sys.argv[1:]), errors.USER_ERROR)
        if type(error) is ValueError and _module_of(error).startswith(ONE_LINE_FROM):
            errors.end(NAME, " ".join(str(error).split()), errors.USER_ERROR)
        errors.end_in_one_line(NAME, error)


def _module_of(error: Exception) -> str:
    """Return the name of the module that raised an error."""
    *_, (frame, _) = traceback.walk_tb(error.__traceback__)
    return str(frame.f_globals["__name__"])


def _for_hydra(arguments: list[str]) -> list[str]:
    """Return the user's arguments in the form that Hydra reads.

    Raises:
        UserError: there is a mistake in them.
    """
    if "${" in str(Path.cwd()):
        raise errors.UserError(
            "the path of the current folder contains ${, which Hydra resolves. Use another."
        )
    arguments = flags_first(arguments)
    check_overrides(arguments)
    if any(key(argument) == "evaluate" for argument in arguments):
        from mops_lightning.training.evaluation import command_line

        arguments = command_line(arguments)
    return with_own_classes([with_home(readable(argument)) for argument in arguments])


def flags_first(arguments: list[str]) -> list[str]:
    """Move Hydra's flags, such as ``--multirun``, before the settings: Hydra wants these together.

    Args:
        arguments: the whole command line, such as ``["m=8", "--cfg", "job", "sampler=fps"]``.

    Returns:
        The same arguments; flags with their values and settings keep their order.

    Raises:
        UserError: there is no such flag, or a flag's value is missing or not allowed.
    """
    from hydra._internal.utils import get_args_parser

    parser = get_args_parser()
    parser.exit_on_error = False
    parser.allow_abbrev = False  # an ambiguous abbreviation exits in any case
    try:
        read, unknown = parser.parse_known_intermixed_args(arguments)
    except argparse.ArgumentError as error:
        raise errors.UserError(f"{error.argument_name}: {error.message}.") from None
    known = [action.option_strings[0] for action in parser._actions if action.option_strings]
    for flag in unknown:
        hint = errors.did_you_mean(flag.split("=")[0], known)
        raise errors.UserError(f"no flag {flag!r}.{hint} Settings are KEY=VALUE, without dashes.")
    if read.experimental_rerun:
        raise errors.UserError(
            "--experimental-rerun is not available, because the pickle that it reads can run code. "
            "Repeat the run with the overrides in its result.json."
        )
    flags = list(arguments)
    for setting in read.overrides:
        flags.remove(setting)
    if read.package and not read.cfg:
        raise errors.UserError(
            f"--package {read.package}: chooses what --cfg shows. Add --cfg job, or leave it out."
        )
    if flags[-1:] in (["-i"], ["--info"]):  # a setting behind it would be taken for its value
        flags[-1] = "--info=all"
    return [*flags, *read.overrides]


def _job(cfg: "DictConfig") -> float | None:
    """Run one job and return its score, which an optimising sweeper reads.

    The user's mistakes end the program here, because Hydra adds lines to an error.

    Raises:
        KeyboardInterrupt: the user has stopped the job.
    """
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode

    from mops_lightning.cli.start import line_about_run
    from mops_lightning.cli.sweep import run_cell
    from mops_lightning.config import distributed
    from mops_lightning.training.run.run import run_in

    hydra_cfg = HydraConfig.get()
    swept = hydra_cfg.mode == RunMode.MULTIRUN
    folder = Path(os.path.relpath(hydra_cfg.runtime.output_dir))
    overrides = as_typed(hydra_cfg.overrides.task)
    score: float | None = None
    with errors.quiet_on_closed_pipe():
        try:
            if swept:
                distributed.check_multirun(cfg)
                score = run_cell(cfg, folder, overrides)
            else:
                score = run_in(folder, cfg, overrides).score
        except BrokenPipeError:
            raise
        except errors.Interrupted as stop:
            if distributed.is_worker_rank(cfg):
                sys.exit(errors.INTERRUPTED)  # rank 0 prints the message
            text = str(stop)
            if swept:
                sweep_folder = os.path.relpath(hydra_cfg.sweep.dir)
                text = (
                    f"Run the same command with hydra.sweep.dir={sweep_folder} "
                    "to continue the sweep."
                )
            # Hydra passes this on like any other error.
            raise KeyboardInterrupt(text) from None
        except Exception as error:
            line = line_about_run(error, overrides)
            if line is None:
                raise
            errors.end(NAME, line, errors.USER_ERROR)
    if swept and hydra_cfg.sweeper._target_ not in NO_OPTIMISERS:
        _check_score(score, folder)
    return score


def _check_score(score: float | None, folder: Path) -> None:
    """Tell an optimising sweeper that a trial has failed: by an exception, for it records no NaN.

    Raises:
        UserError: there is no score.
    """
    if score is None or math.isnan(score):
        raise errors.UserError(f"{folder} has no score; its log and result.json say why.")
