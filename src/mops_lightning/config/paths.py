"""Checking the files and folders that settings name, before anything is done with them."""

from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from mops_lightning.errors import UserError

INPUTS = {
    "weights": ("auto", "run"),
    "ckpt_path": ("last",),
    "evaluate": (),
    "dataset.root": (),
    "dataset.motions": (),
    "dataset.calib": (),
}
"""Settings that name what must exist, with values that are no paths."""
OUTPUTS = ("out", "cache", "dataset.cache")
MISSING = {"ckpt_path": "no checkpoint {}. Give a run's folder, a .ckpt file, or last."}
"""Errors of inputs that nothing else checks before a run begins."""


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
