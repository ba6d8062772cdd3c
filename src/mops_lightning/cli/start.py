"""Checks before Hydra writes anything into the folder of a single run."""

import sys
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from mops_lightning.config import distributed
from mops_lightning.config.compose import explain
from mops_lightning.errors import USER_ERROR, UserError, end, file_error, memory_error
from mops_lightning.zoo import names

INPUTS = {
    "weights": ("auto", "run"),
    "ckpt_path": ("last",),
    "evaluate": (),
    "dataset.root": (),
}
"""Settings that name an existing file or folder, with values that are not paths."""
OUTPUTS = ("out", "cache", "dataset.cache")
MISSING = {
    "ckpt_path": "no checkpoint {}. Give a run's folder, a .ckpt file, or last.",
    "weights": "no file {}. Give a weights file, a run, a model, or weights=auto.",
}
"""Errors of inputs that nothing else checks before a run begins."""


class RunStart(Callback):
    """Checks a single run and claims its folder, so that a refused run leaves nothing."""

    def on_run_start(self, config: DictConfig, **extra: Any) -> None:
        """Check the settings and claim the folder, before Hydra writes into it.

        Raises:
            SystemExit: a setting is wrong, or the folder contains a run; one line says so.
        """
        from mops_lightning.training.run.run import checked, claim

        HydraConfig.instance().set_config(config)  # the folder's name is made from it
        cfg = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
        try:
            folder = Path(config.hydra.run.dir)
            settings = checked(cfg, list(config.hydra.overrides.task))
            if cfg.evaluate:  # the job gets the settings of the trained run
                with open_dict(config):
                    for name in settings:
                        config[name] = settings[name]
            check_paths(cfg)
            distributed.check_start(cfg, config.hydra.overrides.hydra)
            if not distributed.is_worker_rank(cfg):
                claim(folder)
        except (UserError, OmegaConfBaseException) as error:
            end("mops_lightning", explain(error, sys.argv[1:]), USER_ERROR)
        except OSError as error:
            end("mops_lightning", file_error(error), USER_ERROR)


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
            # Python: no such user, a null byte.
            reason = error.strerror if isinstance(error, OSError) else str(error)
            raise UserError(f"{name}: {_short(value)}: {reason}.") from None


def _check_missing(name: str, value: str) -> None:
    """Refuse a path that does not exist where the setting needs one; ``weights`` may be a model."""
    try:
        found = names.resolve(value).exists() if name == "weights" else False
    except UserError as error:
        raise UserError(f"{name}: {error}") from None
    if name in MISSING and not found:
        raise UserError(f"{name}: {MISSING[name].format(value)}")


def _short(text: str) -> str:
    return text if len(text) <= 100 else f"{text[:60]} ... ({len(text)} characters)"


def line_about(error: BaseException) -> str | None:
    """Return one line about an error that the user can mend; None for a fault of the program."""
    if isinstance(error, UserError):
        return str(error)
    return file_error(error) if isinstance(error, OSError) else memory_error(error)
