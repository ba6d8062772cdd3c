"""The checkpoint to resume from: finding it, and checking that it is finite and this run's."""

import hashlib
import io
import json
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.strategies import Strategy

from mops_lightning.config.shared_settings import training_settings
from mops_lightning.config.shortened import UNLIMITED
from mops_lightning.errors import UserError
from mops_lightning.zoo import model_file, weights

CHECKPOINT = "last.ckpt"
CHECKPOINT_KEY = "mops_lightning"
"""Key of the run's identity in a checkpoint."""

ENDING = "mops_lightning_ending"
"""Key of the ``Ending`` in a checkpoint."""

THREADS = "mops_lightning_threads"
"""Key of the number of threads of torch in a checkpoint."""

LENGTH = "trainer.max_epochs"
"""The planned length of a run."""

SAVED = ("state_dict", "current_model_state", "optimizer_states")
"""Parts of a checkpoint that hold tensors of the training; the second is of a moving average."""

SEAL_BYTES = hashlib.sha256().digest_size


def checkpoint_identity(config: dict[str, Any], fingerprint: str) -> dict[str, str]:
    """Return the values that must be equal for a checkpoint to be resumed, as JSON by setting.

    These are the settings that affect training (see ``config.settings``), and hashes of the files
    that settings name. ``LENGTH`` may differ: a completed run can be extended.

    Args:
        config: the run's settings as plain data, interpolations resolved.
        fingerprint: the data set's fingerprint.
    """
    parts = {**training_settings(config), "dataset": fingerprint}
    if config["weights"] not in (None, "auto", "run"):
        parts["weights"] = _sha256("weights", config["weights"])
    if config["learn"] == "sampler":
        others = config.get("other_nets") or []
        for number, name in enumerate(others, 1):
            parts[f"other_nets.{number}"] = _sha256("other_nets", name)
    return {name: json.dumps(value, sort_keys=True) for name, value in parts.items()}


def _sha256(setting: str, name: str) -> str:
    """Return the hash of the task net's weights that a setting names, from the file's header."""
    try:
        return str(model_file.read_header(weights.of_task_net(name))["sha256"])
    except UserError as error:
        raise UserError(f"{setting}: {error}") from None


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint that training can be resumed from.

    Attributes:
        path: the file.
        identity: identity of the run that wrote it; see ``checkpoint_identity``.
        planned: epochs for which this run was planned.
        done: epochs that it had trained.
        steps: optimizer steps that it had trained.
        ending: whether its training was told to stop before ``planned``.
        threads: number of threads of torch; None in checkpoints of earlier versions.
    """

    path: Path
    identity: dict[str, str]
    planned: int
    done: int
    steps: int
    ending: "Ending"
    threads: int | None = None

    @classmethod
    def read(cls, path: Path) -> "Checkpoint":
        """Read what identifies a checkpoint.

        Raises:
            UserError: the file is no checkpoint as it was written.
        """
        content = read_sealed(path)
        written_by = content[CHECKPOINT_KEY]
        progress = content["loops"]["fit_loop"]["epoch_progress"]["current"]
        return cls(
            path,
            identity=written_by,
            planned=int(json.loads(written_by[LENGTH])),
            done=int(progress["processed"]),
            steps=int(content["global_step"]),
            ending=Ending.of(content),
            threads=content.get(THREADS),
        )


@dataclass(frozen=True)
class Ending:
    """How the training that wrote a checkpoint was about to end.

    Attributes:
        should_stop: whether a callback or a limit had told the trainer to stop.
        validation: metrics of the last validation by name; empty before the first one.
    """

    should_stop: bool = False
    validation: dict[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, content: dict[str, Any]) -> "Ending":
        """Read it from the content of a checkpoint; one of another program says nothing."""
        return cls(**content.get(ENDING, {}))

    def plain(self) -> dict[str, Any]:
        """Return it as plain data for a checkpoint."""
        return asdict(self)


def find_checkpoint(name: str, out: Path, identity: dict[str, str]) -> Checkpoint:
    """Return the checkpoint that ``ckpt_path`` means.

    Args:
        name: ``last`` (the newest run below ``out`` with these settings), a run's folder or a file.
        out: folder for runs.
        identity: this run's; see ``checkpoint_identity``.

    Raises:
        UserError: there is no such checkpoint, it belongs to other settings, or it has more epochs
            than ``trainer.max_epochs``.
    """
    if name == "last":
        checkpoint = _newest(out, identity)
    else:
        checkpoint = _named(name, identity)
    epochs = int(json.loads(identity[LENGTH]))
    if epochs != UNLIMITED and epochs < checkpoint.done:
        raise UserError(
            f"trainer.max_epochs must be at least {checkpoint.done}, the epochs of "
            f"{checkpoint.path}, got {epochs}."
        )
    return checkpoint


def _named(name: str, identity: dict[str, str]) -> Checkpoint:
    """Return the checkpoint of the run's folder or file that ``ckpt_path`` names."""
    path = Path(name).expanduser()
    if path.is_dir():
        path = path / "checkpoints" / CHECKPOINT
    if not path.is_file():
        raise UserError(f"ckpt_path: no checkpoint {path}. Give a run's folder, a file, or last.")
    try:
        checkpoint = Checkpoint.read(path)
    except UserError as error:
        raise UserError(f"ckpt_path: {error} Give another one, or leave it out.") from None
    different = _different(checkpoint.identity, identity)
    if different:
        key = different[0]
        old = checkpoint.identity.get(key, "not set")
        new = identity.get(key, "not set")
        raise UserError(
            f"ckpt_path: {path} is from a run with other settings ({', '.join(different)}); "
            f"{key} is {new} here and {old} there. "
            "Give the same settings, or leave ckpt_path out to start a new run."
        )
    return checkpoint


def _newest(out: Path, identity: dict[str, str]) -> Checkpoint:
    """Return the newest checkpoint of these settings below ``out``."""
    paths = [path for path in out.glob(f"**/checkpoints/{CHECKPOINT}") if path.is_file()]
    paths.sort(key=_time_written, reverse=True)
    for path in paths:
        with suppress(weights.Damaged):
            checkpoint = Checkpoint.read(path)
            if not _different(checkpoint.identity, identity):
                return checkpoint
    raise UserError(
        f"ckpt_path=last: none of the {len(paths)} checkpoints below {out} has these settings. "
        "Leave ckpt_path out to start a new run, or give a run's folder."
    )


def _time_written(path: Path) -> float:
    return path.stat().st_mtime


def _different(old: dict[str, str], new: dict[str, str]) -> list[str]:
    """Return the parts in which two identities differ, except the length of the training."""
    different = []
    for name in {**new, **old}:
        if name != LENGTH and old.get(name) != new.get(name):
            different.append(name)
    return different


def sealed(content: bytes) -> bytes:
    """Return the bytes of a checkpoint and, behind them, their sha256; ``torch.load`` skips it."""
    return content + hashlib.sha256(content).digest()


def read_sealed(path: Path) -> Any:
    """Read a checkpoint, which must not have changed since it was written.

    A changed counter or tensor would be resumed to another training, silently. Pickled code is
    refused, not executed.

    Raises:
        OSError: the file cannot be opened.
        Damaged: it is not a checkpoint, or was changed.
    """
    written = path.read_bytes()
    content = written[:-SEAL_BYTES]
    seal = written[-SEAL_BYTES:]
    if hashlib.sha256(content).digest() != seal:
        raise weights.damaged(path, "expected a checkpoint as this program wrote it")
    try:
        return torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except Exception:  # torch's messages advise to execute the file's code
        raise weights.damaged(path, "expected a checkpoint of plain data") from None


class Diverged(UserError):
    """A loss, a weight or a score is NaN or infinite."""


def check_finite(values: dict[str, Any], steps: int, strategy: Strategy) -> None:
    """End training, on all processes of a run, if a value of one is not finite.

    Args:
        values: tensors by name, nested as in a checkpoint.
        steps: number of optimizer steps so far.
        strategy: Lightning's; reaches the other processes.

    Raises:
        Diverged: a value is NaN or infinite.
    """
    name = weights.first_nonfinite(values)
    if strategy.reduce_boolean_decision(name is not None, all=False):
        raise Diverged(f"training diverged: {name or 'a value'} is not finite at step {steps}.")
