"""Weights files: plain tensors and plain data, checked when read."""

import io
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from mops_lightning.errors import UserError
from mops_lightning.filesystem import atomic_write
from mops_lightning.records import run_record
from mops_lightning.zoo import bounds, model_file, names
from mops_lightning.zoo.digest import digest

SCHEMA = "mops_lightning/weights/1"
FILE = "weights.pt"
OTHER_NET = "Check task, task/net and dataset.classes, or use weights=auto."


class Damaged(UserError):
    """A file of this program that cannot be used any more, or a file of another program."""


def save(
    path: Path,
    module: nn.Module,
    config: dict[str, Any],
    metrics: dict[str, float],
    classes: Sequence[str] = (),
) -> None:
    """Write a module's tensors with the configuration and the metrics of their training.

    Args:
        path: the file; an existing one is replaced atomically.
        module: the module whose ``state_dict`` is written.
        config: the run's configuration as plain data.
        metrics: test metrics by name.
        classes: class names in the order of the outputs of a classifier.
    """
    state = {name: value.detach().cpu().contiguous() for name, value in module.state_dict().items()}
    content = {
        "schema": SCHEMA,
        "config": config,
        "metrics": metrics,
        "classes": list(classes),
        "sha256": digest(state),
        "state": state,
    }
    write_plain(path, content)


def write_plain(path: str | Path, content: dict[str, Any]) -> None:
    """Write plain tensors and plain data; an existing file is replaced when all is written.

    Raises:
        OSError: the file cannot be written. ``torch.save`` raises other errors at a full disk.
    """
    buffer = io.BytesIO()
    torch.save(content, buffer)
    with atomic_write(path) as temporary:
        temporary.write_bytes(buffer.getbuffer())


def read(path: str | Path) -> dict[str, Any]:
    """Read a weights file or a model and verify it.

    Args:
        path: a weights file, or what ``names.resolve`` takes.

    Returns:
        The content as saved: ``config``, ``metrics``, ``classes``, ``sha256`` and ``state``.

    Raises:
        UserError: the file is missing.
        Damaged: it is damaged or not a weights file, or its tensors are not finite.
    """
    path = names.resolve(path)
    if not path.is_file():
        raise UserError(f"no file {path}. Give a weights.pt, the folder of its run, or a model.")
    if path.suffix == model_file.SUFFIX:
        content = model_file.read(path)
        check_state(content["state"], path)
        return content
    content = read_plain(path, "a weights file")
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        raise Damaged(
            f"{path} is not a weights file of mops_lightning. "
            "Lightning checkpoints are for ckpt_path; weights.pt is in the run's folder."
        )
    content = {"config": {}, "metrics": {}, "classes": [], "sha256": None, **content}
    check_state(content.get("state"), path)
    if digest(content["state"]) != content["sha256"]:
        raise Damaged(f"{path} is damaged (sha256 differs). Delete it and run again.")
    if not _is_plain(content["config"], dict) or not _is_plain(content["classes"], list):
        raise Damaged(f"{path} is damaged (config or classes). Delete it and run again.")
    return content


def check_state(state: Any, path: str | Path) -> None:
    """Reject what is not a ``state_dict`` of finite tensors.

    Args:
        state: of a file.
        path: the file, for the error.

    Raises:
        Damaged: it is not one, or a tensor contains NaN or infinity.
    """
    if not isinstance(state, dict) or not all(
        isinstance(name, str)
        and isinstance(value, Tensor)
        and value.layout == torch.strided
        # of 8 bits: torch cannot test these for NaN
        and not (value.is_floating_point() and value.element_size() == 1)
        for name, value in state.items()
    ):
        raise Damaged(f"{path} is damaged (no tensors by name). Delete it and run again.")
    if name := first_nonfinite(state):
        raise Damaged(f"{path}: {name} is not finite, because the training diverged. Train again.")


def _is_plain(value: Any, kind: type) -> bool:
    """Return whether a value of a file is of a kind and holds plain data that JSON can hold."""
    try:
        json.dumps(value)
    except (TypeError, ValueError, RecursionError):
        return False
    return isinstance(value, kind)


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
        bounds.check_archive(path)
        content = torch.load(path, map_location="cpu", weights_only=True)
        bounds.check_content(content, path)
        return content
    except PermissionError:
        raise UserError(f"{path} may not be read. Check its permissions.") from None
    except Exception:  # torch's messages advise to execute the file's code
        raise Damaged(
            f"{path} is damaged or not a file of this program (expected {what})."
        ) from None


def of_run(run: Path, kind: str = "weights") -> Path:
    """Return the file with the weights of a run.

    Args:
        run: the run's folder, or a model file. The record of the run names a file relative to its
            folder, or a model.
        kind: ``weights``, of what was trained, or ``task_weights``, of the task net.

    Returns:
        Without a record, or if the record names no file: ``weights.pt`` or ``task_weights.pt``.

    Raises:
        UserError: the folder contains a ``result.json`` that is not a run record, or the model that
            it names now has other weights.
    """
    if run.is_file():
        if kind == "weights":
            return run
        files, run = model_file.read_card(run)["record"]["files"], run.parent
    else:
        has_record = (run / run_record.FILE).is_file()
        files = run_record.read(run).files if has_record else {}
    named = files.get(kind, f"{kind}.pt")
    path = run / named
    return path if path.exists() else names.find(named) or path


def load_into(module: nn.Module, path: str | Path) -> dict[str, Any]:
    """Read a weights file into a module, strictly.

    Returns:
        The file's content; see ``read``.

    Raises:
        UserError: the file cannot be read, or its tensors do not match the module.
    """
    content = read(path)
    fit_state(module, content["state"], path)
    return content


def fit_state(
    module: nn.Module, state: dict[str, Tensor], path: str | Path, hint: str = OTHER_NET
) -> None:
    """Load tensors into a module, strictly.

    Args:
        module: the module to fill.
        state: its tensors by name.
        path: the file that they come from, for the error.
        hint: what to try next, for the error.

    Raises:
        UserError: names or shapes differ from the module's.
    """
    check_shapes(module, state, path, hint)
    module.load_state_dict(state, strict=True)


def check_shapes(
    module: nn.Module, state: dict[str, Tensor], path: str | Path, hint: str = OTHER_NET
) -> None:
    """Reject tensors whose names or shapes are not a module's.

    Arguments and errors are those of ``fit_state``.
    """
    expected = module.state_dict()
    wrong = [f"{name} is missing" for name in expected if name not in state]
    wrong += [f"{name} is unknown" for name in state if name not in expected]
    wrong += [
        f"{name} is {tuple(state[name].shape)} instead of {tuple(expected[name].shape)}"
        for name in expected
        if name in state and state[name].shape != expected[name].shape
    ]
    if wrong:
        more = f" and {len(wrong) - 3} more" if len(wrong) > 3 else ""
        raise UserError(f"{path} holds another net's weights: {'; '.join(wrong[:3])}{more}. {hint}")


def first_nonfinite(state: Any, name: str = "") -> str | None:
    """Return the dotted name of the first tensor with NaN or infinity in nested data, if any."""
    if isinstance(state, Tensor):
        return None if bool(torch.isfinite(state).all()) else name
    parts: Iterable[tuple[Any, Any]] = ()
    if isinstance(state, Mapping):
        parts = state.items()
    elif isinstance(state, list | tuple):
        parts = enumerate(state)
    named = ((f"{name}.{key}" if name else str(key), value) for key, value in parts)
    return next(filter(None, (first_nonfinite(value, path) for path, value in named)), None)
