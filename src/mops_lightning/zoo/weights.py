"""Weights of runs and models: saved, read and loaded into modules, strictly."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from textwrap import shorten
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from mops_lightning.channels import NO_CHANNELS, PointChannels
from mops_lightning.errors import UserError
from mops_lightning.records import run_record
from mops_lightning.zoo import model_file, names
from mops_lightning.zoo.model_file import Damaged as Damaged
from mops_lightning.zoo.model_file import damaged as damaged
from mops_lightning.zoo.model_file import digest as digest
from mops_lightning.zoo.rounding import SCALE, restored

FILE = f"weights{model_file.SUFFIX}"
OTHER_NET = "Check task, task/net, samplers inside it and dataset.classes, or use weights=auto."


def save(
    path: Path,
    module: nn.Module,
    config: dict[str, Any],
    metrics: dict[str, float],
    classes: Sequence[str] = (),
    channels: PointChannels = NO_CHANNELS,
) -> None:
    """Write a module's tensors with the configuration and the metrics of their training.

    Args:
        path: the file; an existing one is replaced atomically.
        module: the module whose ``state_dict`` is written.
        config: the run's configuration as plain data.
        metrics: test metrics by name.
        classes: names of classes or parts in the order of the outputs of a task net.
        channels: of the points that it was trained on.
    """
    header: dict[str, Any] = {
        "schema": model_file.WEIGHTS,
        "config": config,
        "metrics": metrics,
        "classes": list(classes),
    }
    if channels:
        header["channels"] = channels.to_plain()
    state = {
        name: value.detach().cpu().clone(memory_format=torch.contiguous_format)
        for name, value in module.state_dict().items()
    }
    model_file.write(path, header, state)


def read(path: str | Path) -> dict[str, Any]:
    """Read a weights file or a model and verify it.

    Args:
        path: a weights file, or what ``names.resolve`` takes.

    Returns:
        ``config``, ``metrics``, ``classes``, ``channels``, ``sha256``, and ``state``, the tensors
        by name; matrices that ``rounding`` wrote in 8 bits are float32.

    Raises:
        UserError: the file is missing, or may not be read.
        Damaged: it is damaged or not a weights file, or its tensors are not finite.
    """
    path = names.resolve(path)
    header = model_file.read_header(path)
    try:
        state = load_file(path)
    except (SafetensorError, OSError):
        raise damaged(path) from None
    if digest(state) != header["sha256"]:
        raise damaged(path, "sha256 differs")
    restored_state = restored(state)
    for name, value in restored_state.items():
        if value.element_size() == 1 and value.dtype != torch.bool:
            raise Damaged(
                f"{path}: {name} is quantised ({value.dtype}). Give it in 16 or 32 bits, or in "
                f"int8 with {name}{SCALE} in float32, a row each."
            )
    wrong = first_nonfinite(state) or first_nonfinite(restored_state)
    if wrong:
        raise damaged(path, f"{wrong} is not finite, because the training diverged")
    trained = header.get("record", header)
    return {
        "config": trained["config"],
        "metrics": trained["metrics"],
        "classes": header["classes"],
        "channels": channels_in(header),
        "sha256": header["sha256"],
        "state": restored_state,
    }


def channels_in(header: Mapping[str, Any]) -> PointChannels:
    """Return the channels that the header of a weights file or a model names."""
    return PointChannels.from_plain(header.get("channels", []))


def of_run(run: Path, kind: str = "weights") -> Path:
    """Return the file with the weights of a run.

    Args:
        run: the run's folder, or a model file. The record of the run names a file relative to its
            folder, or a model. Any other path is the file with the weights.
        kind: ``weights``, of what was trained, or ``task_weights``, of the task net.

    Returns:
        Without a record, or if the record names no file: ``weights.safetensors`` or
        ``task_weights.safetensors``.

    Raises:
        UserError: the folder contains a ``result.json`` that is not a run record, or the model that
            it names now has other weights.
    """
    if kind == "weights" and not run.is_dir():
        return run
    if run.is_file():
        files = model_file.read_card(run)["record"]["files"]
        run = run.parent
    else:
        files = {}
        if (run / run_record.FILE).is_file():
            files = run_record.read(run).files
    named = files.get(kind, f"{kind}{model_file.SUFFIX}")
    path = run / named
    if path.exists():
        return path
    return names.find_model(named) or path


def of_task_net(reference: str | Path) -> Path:
    """Return the file with the weights of a task net. A path that is not a folder is the file.

    Args:
        reference: what ``names.resolve`` takes, or the folder of a run that trained a task net,
            alone or with a sampler.

    Raises:
        UserError: there is no file and no model of this name, or the folder's record is damaged.
    """
    path = names.resolve(reference)
    if not path.is_dir():
        return path
    joint = of_run(path, "task_weights")
    if joint.is_file():
        return joint
    return of_run(path)


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
    module: nn.Module,
    state: dict[str, Tensor],
    path: str | Path,
    hint: str = OTHER_NET,
    assign: bool = False,
) -> None:
    """Load tensors into a module, strictly.

    Args:
        module: the module to fill.
        state: its tensors by name.
        path: the file that they come from, for the error.
        hint: what to try next, for the error.
        assign: take the tensors themselves, for a module without memory.

    Raises:
        UserError: names or shapes differ from the module's.
    """
    try:
        module.load_state_dict(state, strict=True, assign=assign)
    except RuntimeError as error:
        _, *differences = str(error).splitlines()
        listed = shorten(" ".join(differences), 300)
        raise UserError(f"{path} holds another net's weights: {listed} {hint}") from None


def first_nonfinite(state: Any, name: str = "") -> str | None:
    """Return the dotted name of the first tensor with NaN or infinity in nested data, if any."""
    if isinstance(state, Tensor):
        if bool(torch.isfinite(state).all()):
            return None
        return name
    parts: Iterable[tuple[Any, Any]] = ()
    if isinstance(state, Mapping):
        parts = state.items()
    elif isinstance(state, list | tuple):
        parts = enumerate(state)
    for key, value in parts:
        path = str(key)
        if name:
            path = f"{name}.{key}"
        nonfinite = first_nonfinite(value, path)
        if nonfinite:
            return nonfinite
    return None
