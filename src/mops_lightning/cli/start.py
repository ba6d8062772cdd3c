"""Checks before Hydra writes anything into the folder of a single run."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mops_lightning.config import distributed
from mops_lightning.config.explain import explain
from mops_lightning.errors import USER_ERROR, UserError, end, file_error
from mops_lightning.zoo import names

INPUTS = {
    "weights": ("auto", "run"),
    "ckpt_path": ("last",),
    "evaluate": (),
    "dataset.root": (),
}
"""Settings that name what must exist, with values that are no paths."""
OUTPUTS = ("out", "cache", "dataset.cache")
MISSING = {"ckpt_path": "no checkpoint {}. Give a run's folder, a .ckpt file, or last."}
"""Errors of inputs that nothing else checks before a run begins."""


class RunStart(Callback):
    """Checks a single run before Hydra writes into its folder."""

    def on_run_start(self, config: DictConfig, **extra: Any) -> None:
        """Check the settings and claim the folder."""
        begin(config, sys.argv[1:])


def begin(config: DictConfig, arguments: Sequence[str]) -> None:
    """Check the settings of a run and claim its folder, so that a refused run leaves nothing.

    Args:
        config: with Hydra's own settings.
        arguments: of the command line.

    Raises:
        SystemExit: a setting is wrong, or the folder contains a run; one line says so.
    """
    from mops_lightning.training.run.run import checked, claim

    HydraConfig.instance().set_config(config)  # the folder's name is made from it
    cfg = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
    try:
        folder = Path(config.hydra.run.dir)
        checked(cfg, list(config.hydra.overrides.task))
        check_paths(cfg)
        _check_weights(cfg.weights)
        distributed.check_start(cfg, config.hydra.overrides.hydra)
        if not distributed.is_worker_rank(cfg):
            claim(folder)
    except (UserError, OmegaConfBaseException) as error:
        end("mops_lightning", explain(error, arguments), USER_ERROR)
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
            if name in MISSING:
                raise UserError(f"{name}: {MISSING[name].format(path)}") from None
        except (OSError, RuntimeError, ValueError) as error:
            # Python: no such user, a null byte.
            reason = error.strerror if isinstance(error, OSError) else str(error)
            raise UserError(f"{name}: {_short(value)}: {reason}.") from None


def _short(text: str) -> str:
    return text if len(text) <= 100 else f"{text[:60]} ... ({len(text)} characters)"


def _check_weights(given: str | None) -> None:
    """Check that there is a file, run or model where ``weights`` names one.

    Raises:
        UserError: there is none.
    """
    if given is None or given in INPUTS["weights"]:
        return
    try:
        path = names.resolve(given)
    except UserError as error:
        raise UserError(f"weights: {error}") from None
    if not path.exists():
        raise UserError(
            f"weights: no file {path}. Give a weights file, a run, a model, or weights=auto."
        )


def make(folder: Path) -> None:
    """Make the folder of a sweep, or end the program.

    Raises:
        SystemExit: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        text = f"out: cannot write to {folder}: {error.strerror}."
        end("mops_lightning", text, USER_ERROR)
