"""Finding the checkpoint to resume from, and checking that it belongs to this run."""

import json
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from mops_lightning.config.comparison import trained_with
from mops_lightning.errors import UserError
from mops_lightning.training.callbacks import CHECKPOINT
from mops_lightning.training.experiment import CHECKPOINT_KEY
from mops_lightning.zoo import weights

LENGTH = "trainer.max_epochs"
"""The planned length of a run."""


def identity(cfg: DictConfig, fingerprint: str) -> dict[str, str]:
    """Return the values that must be equal for a checkpoint to be resumed, as JSON by setting.

    These are the settings that affect training (see ``config.settings``), and hashes of the files
    that settings name. ``LENGTH`` may differ: a completed run can be extended.

    Args:
        cfg: the run's settings.
        fingerprint: the data set's fingerprint.
    """
    plain: Any = OmegaConf.to_container(cfg, resolve=True)
    parts = {**trained_with(plain), "dataset": fingerprint, **_given_weights(cfg)}
    return {name: json.dumps(value, sort_keys=True) for name, value in parts.items()}


def _given_weights(cfg: DictConfig) -> dict[str, str]:
    """Return the hash of the weights file that the user gave, if any."""
    if cfg.weights in (None, "auto", "run") or not Path(cfg.weights).expanduser().is_file():
        return {}
    try:
        return {"weights": str(weights.read(cfg.weights)["sha256"])}
    except UserError as error:
        raise UserError(f"weights: {error}") from None


def lengthened(cfg: DictConfig, checkpoint: Path) -> bool:
    """Return whether this run is planned longer than the run that wrote ``checkpoint``."""
    return bool(cfg.trainer.max_epochs > planned_epochs(checkpoint))


def planned_epochs(checkpoint: Path) -> int:
    """Return the planned length of the run that wrote ``checkpoint``."""
    return int(json.loads(_read(checkpoint)[CHECKPOINT_KEY][LENGTH]))


def find(cfg: DictConfig, mine: dict[str, str]) -> Path | None:
    """Return the checkpoint that ``ckpt_path`` means, or None when it is not set.

    Args:
        cfg: ``ckpt_path`` may be ``last`` (the newest run below ``out`` with these settings), a
            run's folder or a file.
        mine: this run's ``identity``.

    Raises:
        UserError: there is no such checkpoint, it belongs to other settings, or it has more epochs
            than ``trainer.max_epochs``.
    """
    if cfg.ckpt_path is None:
        return None
    last = cfg.ckpt_path == "last"
    path = _newest(Path(cfg.out), mine) if last else _given(cfg, mine)
    done = _read(path)["loops"]["fit_loop"]["epoch_progress"]["current"]["processed"]
    if cfg.trainer.max_epochs < done:
        raise UserError(
            f"trainer.max_epochs must be at least {done}, the epochs of {path}, got "
            f"{cfg.trainer.max_epochs}."
        )
    return path


def _given(cfg: DictConfig, mine: dict[str, str]) -> Path:
    """Return the checkpoint of the run's folder or file that ``ckpt_path`` names."""
    path = Path(cfg.ckpt_path).expanduser()
    if path.is_dir():
        path = path / "checkpoints" / CHECKPOINT
    if not path.is_file():
        raise UserError(
            f"ckpt_path: no checkpoint {path}. Give a run's folder, a .ckpt file, or last."
        )
    theirs = _read(path)[CHECKPOINT_KEY]
    different = _different(theirs, mine)
    if different:
        name = different[0]
        raise UserError(
            f"ckpt_path: {path} is from a run with other settings ({', '.join(different)}); "
            f"{name} is {mine.get(name)} here and {theirs.get(name)} there. "
            "Give the same settings, or leave ckpt_path out to start a new run."
        )
    return path


def _newest(out: Path, mine: dict[str, str]) -> Path:
    found = sorted(
        out.glob(f"**/checkpoints/{CHECKPOINT}"), key=lambda p: p.stat().st_mtime, reverse=True
    )
    for path in found:
        try:
            theirs = _read(path)[CHECKPOINT_KEY]
        except UserError:
            continue
        if not _different(theirs, mine):
            return path
    raise UserError(
        f"ckpt_path=last: none of the {len(found)} checkpoints below {out} has these settings. "
        "Leave ckpt_path out to start a new run, or give a run's folder."
    )


def _different(theirs: dict[str, str], mine: dict[str, str]) -> list[str]:
    names = [name for name in {**mine, **theirs} if name != LENGTH]
    return [name for name in names if theirs.get(name) != mine.get(name)]


def _read(path: Path) -> dict[str, Any]:
    try:
        content = weights.read_plain(path, "a checkpoint")
    except UserError as error:
        raise UserError(f"ckpt_path: {error}") from None
    if not isinstance(content, dict) or CHECKPOINT_KEY not in content:
        raise UserError(f"ckpt_path: {path} is not a checkpoint of this program.")
    return content
