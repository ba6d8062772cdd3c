"""Finding the checkpoint to resume from, and checking that it belongs to this run."""

import json
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from mops_lightning.config.shared_settings import training_settings
from mops_lightning.errors import UserError
from mops_lightning.filesystem import set_aside
from mops_lightning.records import run_record
from mops_lightning.zoo import weights

CHECKPOINT = "last.ckpt"
CHECKPOINT_KEY = "mops_lightning"
"""Where a checkpoint keeps the identity of its run."""

LENGTH = "trainer.max_epochs"
"""The planned length of a run."""

PARTS = {CHECKPOINT_KEY: dict, "state_dict": dict, "optimizer_states": list, "loops": dict}
"""What resuming needs of a checkpoint, with its types."""


def identity(config: dict[str, Any], fingerprint: str) -> dict[str, str]:
    """Return the values that must be equal for a checkpoint to be resumed, as JSON by setting.

    These are the settings that affect training (see ``config.settings``), and hashes of the files
    that settings name. ``LENGTH`` may differ: a completed run can be extended.

    Args:
        config: the run's settings as plain data, interpolations resolved.
        fingerprint: the data set's fingerprint.
    """
    parts = {
        **training_settings(config),
        "dataset": fingerprint,
        **_given_weights(config["weights"]),
    }
    return {name: json.dumps(value, sort_keys=True) for name, value in parts.items()}


def _given_weights(given: str | None) -> dict[str, str]:
    """Return the hash of the weights file that the user gave, if any."""
    if given is None or given in ("auto", "run"):
        return {}
    try:
        return {"weights": str(weights.read(weights.of_task_net(given))["sha256"])}
    except UserError as error:
        raise UserError(f"weights: {error}") from None


def lengthened(cfg: DictConfig, checkpoint: Path) -> bool:
    """Return whether this run is planned longer than the run that wrote ``checkpoint``."""
    return bool(cfg.trainer.max_epochs > planned_epochs(read(checkpoint)))


def find(cfg: DictConfig, mine: dict[str, str]) -> Path | None:
    """Return the checkpoint that ``ckpt_path`` means; None where training starts at the beginning.

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
    path = _newest(cfg, mine) if cfg.ckpt_path == "last" else _given(cfg, mine)
    if path is None:
        return None
    done = _epochs_done(read(path))
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
    try:
        theirs = read(path)[CHECKPOINT_KEY]
    except UserError as error:
        raise UserError(
            f"ckpt_path: {error} Give another one, or leave ckpt_path out to start a new run."
        ) from None
    different = _different(theirs, mine)
    if different:
        name = different[0]
        raise UserError(
            f"ckpt_path: {path} is from a run with other settings ({', '.join(different)}); "
            f"{name} is {mine.get(name, 'not set')} here and {theirs.get(name, 'not set')} there. "
            "Give the same settings, or leave ckpt_path out to start a new run."
        )
    return path


def _newest(cfg: DictConfig, mine: dict[str, str]) -> Path | None:
    """Return the newest checkpoint of these settings; None if it was damaged and has no older one.

    Damaged ones are set aside.
    """
    out = Path(cfg.out)
    found = sorted(
        out.glob(f"**/checkpoints/{CHECKPOINT}"), key=lambda p: p.stat().st_mtime, reverse=True
    )
    lost = False
    for path in found:
        if set_aside_if_damaged(path):
            lost |= _run_had(path.parents[1], cfg)
        elif not _different(read(path)[CHECKPOINT_KEY], mine):
            return path
    if lost:
        print("No other checkpoint has these settings: the run starts again.", flush=True)
        return None
    raise UserError(
        f"ckpt_path=last: none of the {len(found)} checkpoints below {out} has these settings. "
        "Leave ckpt_path out to start a new run, or give a run's folder."
    )


def _run_had(folder: Path, cfg: DictConfig) -> bool:
    """Return whether the record in a folder has the settings that affect training here."""
    plain: Any = OmegaConf.to_container(cfg, resolve=True)
    try:
        there = run_record.read(folder).config
        return training_settings({**there, "trainer": plain["trainer"]}) == training_settings(plain)
    except (UserError, KeyError):
        return False


def _different(theirs: dict[str, str], mine: dict[str, str]) -> list[str]:
    names = [name for name in {**mine, **theirs} if name != LENGTH]
    return [name for name in names if theirs.get(name) != mine.get(name)]


def set_aside_if_damaged(path: Path) -> bool:
    """Rename a checkpoint that cannot be resumed, and print one line about it.

    Returns:
        Whether it was damaged.
    """
    try:
        read(path)
    except weights.Damaged as error:
        print(f"{error} Renamed to {set_aside(path).name}.", flush=True)
        return True
    return False


def read(path: Path) -> dict[str, Any]:
    """Read a checkpoint and check that it holds all that resuming needs.

    Raises:
        UserError: the file cannot be opened.
        Damaged: it is damaged, not finite, or not a checkpoint of this program.
    """
    content = read_plain(path, "a checkpoint")
    try:
        planned, done = planned_epochs(content), _epochs_done(content)
        complete = min(planned, done) >= 0 and all(
            isinstance(content[key], kind) for key, kind in PARTS.items()
        )
    except (AttributeError, IndexError, KeyError, TypeError, ValueError):
        complete = False
    if not complete:
        raise weights.Damaged(f"{path} is not a checkpoint of this program.")
    weights.check_state(content["state_dict"], path)
    return content


def read_plain(path: Path, what: str) -> Any:
    """Read a file of plain tensors and plain data; pickled code is refused, not executed.

    Args:
        path: the file.
        what: kind of file that was expected, for the error.

    Raises:
        UserError: the file cannot be opened.
        Damaged: it is damaged, or contains more than plain data.
    """
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except PermissionError:
        raise UserError(f"{path} may not be read. Check its permissions.") from None
    except Exception:  # torch's messages advise to execute the file's code
        raise weights.damaged(path, f"expected {what}") from None


def planned_epochs(content: dict[str, Any]) -> int:
    """Return the planned length of the run that wrote a checkpoint."""
    return int(json.loads(content[CHECKPOINT_KEY][LENGTH]))


def _epochs_done(content: dict[str, Any]) -> int:
    return int(content["loops"]["fit_loop"]["epoch_progress"]["current"]["processed"])
