"""Training from the command line: one run, or a sweep, composed by Hydra."""

import os
import sys
from typing import TYPE_CHECKING

from mops_lightning.cli.commands import help_lines
from mops_lightning.cli.flags import flags_first
from mops_lightning.config.hydra_conf import conf_dir
from mops_lightning.config.overrides import key, readable, with_own_classes
from mops_lightning.errors import (
    INTERRUPTED,
    USER_ERROR,
    Interrupted,
    UserError,
    end,
    file_error,
    memory_error,
    quiet_on_closed_pipe,
)

if TYPE_CHECKING:
    from omegaconf import DictConfig

NAME = "mops_lightning"
"""What error messages start with."""


def main() -> None:
    """Run one job or a sweep; a user's mistake ends in one line and exit status 2."""
    try:
        _run()
    except (KeyboardInterrupt, Interrupted) as stop:
        end(NAME, f"interrupted. {stop}".rstrip(), INTERRUPTED)


def _run() -> None:
    import hydra
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError  # type: ignore[import-untyped]

    from mops_lightning.config.explain import explain, refuse_plain_groups

    OmegaConf.register_new_resolver("subcommands", help_lines, replace=True)
    show_traceback = bool(os.environ.get("HYDRA_FULL_ERROR"))
    # Makes Hydra raise instead of printing its own shortened traceback.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        sys.argv[1:] = flags_first(sys.argv[1:])
        refuse_plain_groups(sys.argv[1:])
        if any(key(argument) == "evaluate" for argument in sys.argv[1:]):
            from mops_lightning.training.evaluation import command_line

            sys.argv[1:] = command_line(sys.argv[1:])
        sys.argv[1:] = with_own_classes([readable(argument) for argument in sys.argv[1:]])
        app = hydra.main(config_path=str(conf_dir()), config_name="config", version_base="1.3")
        app(_job)()
    except (UserError, HydraException, OmegaConfBaseException, YAMLError) as error:
        if show_traceback:
            raise
        end(NAME, explain(error, sys.argv[1:]), USER_ERROR)
    except OSError as error:
        if show_traceback or isinstance(error, BrokenPipeError):
            raise
        end(NAME, file_error(error), USER_ERROR)


def _job(cfg: "DictConfig") -> float | None:
    """Run one job and return its score, which an optimising sweeper reads."""
    # Here and not around Hydra, which adds lines of its own to an error.
    with quiet_on_closed_pipe():
        return _run_job(cfg)


def _run_job(cfg: "DictConfig") -> float | None:
    """Run one job; the user's mistakes end the program in one line.

    Raises:
        BrokenPipeError: the reader of the output has ended.
        KeyboardInterrupt: the user has stopped the job.
    """
    from pathlib import Path

    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode

    from mops_lightning.cli.sweep import run_cell
    from mops_lightning.config import distributed
    from mops_lightning.training.run.run import run

    hydra_cfg = HydraConfig.get()
    folder = Path(os.path.relpath(hydra_cfg.runtime.output_dir))
    overrides = list(hydra_cfg.overrides.task)
    try:
        if hydra_cfg.mode == RunMode.MULTIRUN:
            distributed.check_multirun(cfg)
            return run_cell(cfg, folder, overrides)
        return run(cfg, folder, overrides, claimed=True).score
    except UserError as error:
        end(NAME, str(error), USER_ERROR)
    except BrokenPipeError:
        raise
    except OSError as error:
        end(NAME, file_error(error), USER_ERROR)
    except (MemoryError, RuntimeError) as error:
        text = memory_error(error)
        if text is None:
            raise
        end(NAME, text, USER_ERROR)
    except Interrupted as stop:
        if distributed.is_worker_rank(cfg):
            sys.exit(INTERRUPTED)  # rank 0 prints the message
        # Hydra passes this on like any other error.
        again = "Run the same command with hydra.sweep.dir={} to continue the sweep."
        swept = hydra_cfg.mode == RunMode.MULTIRUN
        text = again.format(os.path.relpath(hydra_cfg.sweep.dir)) if swept else str(stop)
        raise KeyboardInterrupt(text) from None
