"""Checks before Hydra writes anything into the folder of a single run."""

import itertools
import sys
import traceback
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf, open_dict, read_write
from omegaconf.errors import OmegaConfBaseException

from mops_lightning.cli.effect import check_effect
from mops_lightning.config import distributed, overrides, settings
from mops_lightning.config.explain import explain
from mops_lightning.errors import USER_ERROR, UserError, end, end_in_one_line, line_about, one_line
from mops_lightning.zoo import names

INPUTS = {
    "weights": ("auto", "run"),
    "pretrain_from": (),
    "ckpt_path": ("last",),
    "evaluate": (),
    "dataset.root": (),
}
"""Settings that name an existing file or folder, with values that are not paths."""
OUTPUTS = ("out", "cache", "dataset.cache")
MISSING = {
    "ckpt_path": "no checkpoint {}. Give a run's folder, a .ckpt file, or last.",
    "weights": "no file {}. Give a weights file, a run, a model, or weights=auto.",
    "pretrain_from": "no file {}. Give a weights file, a run or a model.",
}
"""Errors of inputs that nothing else checks before a run begins."""
LIGHTNING = ("trainer.", "logger.", "callbacks.")
"""Settings that are arguments of Lightning's classes."""


class RunStart(Callback):
    """Checks a single run and claims its folder, so that a refused run leaves nothing."""

    def on_run_start(self, config: DictConfig, **extra: Any) -> None:
        """Check the settings and claim the folder, before Hydra writes into it.

        Raises:
            SystemExit: a setting is wrong, or the folder contains a run; one line says so.
        """
        from mops_lightning.training.run.run import checked, claim

        HydraConfig.instance().set_config(config)  # the folder's name is made from it
        own_keys = [str(key) for key in config if key != "hydra"]
        cfg = OmegaConf.masked_copy(config, own_keys)
        try:
            given = overrides.as_typed(config.hydra.overrides.task)
            cfg_of_run = checked(cfg, given)
            if cfg.evaluate:  # the job gets the settings of the trained run
                with open_dict(config):
                    for name in cfg_of_run:
                        config[name] = cfg_of_run[name]
            else:
                check_effect(cfg, given)
            check_paths(cfg)
            distributed.check_start(cfg, overrides.as_typed(config.hydra.overrides.hydra))
            if not distributed.is_worker_rank(cfg):
                _use_folder_of_its_own(config)
                claim(Path(config.hydra.run.dir))
        except OmegaConfBaseException as error:
            end("mops_lightning", explain(error, sys.argv[1:]), USER_ERROR)
        except Exception as error:
            end_in_one_line("mops_lightning", error)


def _use_folder_of_its_own(config: DictConfig) -> None:
    """Make the folder of a run, with a number if one that started in the same second has it."""
    patterns: Any = OmegaConf.to_container(config.hydra.run, resolve=False)
    if "${now:" not in patterns["dir"]:
        return
    first = config.hydra.run.dir
    numbered = (f"{first}_{number}" for number in itertools.count(2))
    with read_write(config.hydra):
        for folder in itertools.chain([first], numbered):
            config.hydra.run.dir = folder
            try:
                Path(folder).mkdir(parents=True)
            except FileExistsError:
                continue
            except OSError:
                pass  # claim says what is wrong
            return


def line_about_run(error: Exception, given: list[str]) -> str | None:
    """Return one line about an error of a run that is the user's mistake; None for any other.

    Lightning refuses some of its settings only when it uses them, by errors of any kind.

    Args:
        error: as it was raised.
        given: the overrides.
    """
    line = line_about(error)
    if line is not None or not _is_from_lightning(error):
        return line
    suspects = [argument for argument in given if _is_for_lightning(overrides.path(argument))]
    if not suspects:
        return None
    return f"{' '.join(suspects)}: not usable in this run: {one_line(error)}"


def _is_from_lightning(error: Exception) -> bool:
    """Return whether an error was raised in Lightning's own code."""
    *_, (frame, _) = traceback.walk_tb(error.__traceback__)
    return str(frame.f_globals.get("__name__", "")).startswith("lightning.")


def _is_for_lightning(path: str) -> bool:
    """Return whether a setting is an argument of one of Lightning's classes."""
    return path.startswith(LIGHTNING) and settings.limits(path) is None


def check_paths(cfg: DictConfig) -> None:
    """Check that inputs exist and that no name is impossible: empty, too long, a loop of links.

    Raises:
        UserError: a setting names such a file or folder.
    """
    for name in (*INPUTS, *OUTPUTS):
        value = OmegaConf.select(cfg, name)
        if not isinstance(value, str) or value in INPUTS.get(name, ()):
            continue
        if not value:
            raise UserError(f"{name}: no path is given. Give one, or leave {name} out.")
        try:
            path = Path(value).expanduser()
            path.stat()
        except FileNotFoundError:
            _check_missing(name, value)
        except (OSError, RuntimeError, ValueError) as error:
            reason = str(error)  # Python's own: no such user, a null byte
            if isinstance(error, OSError):
                reason = str(error.strerror)
            reason = reason.rstrip(".")
            raise UserError(f"{name}: {value[:100]}: {reason}.") from None


def _check_missing(name: str, value: str) -> None:
    """Refuse a path that does not exist where the setting needs one; weights may be of a model."""
    if name not in MISSING:
        return
    is_model = False
    if name != "ckpt_path":
        try:
            is_model = names.resolve(value).exists()
        except UserError as error:
            raise UserError(f"{name}: {error}") from None
    if not is_model:
        raise UserError(f"{name}: {MISSING[name].format(value)}")
