"""Samplers and task nets by name or from weights files, without Hydra."""

from collections.abc import Iterable
from functools import cache
from inspect import signature
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

import mops_lightning
from mops_lightning.channels import PointChannels
from mops_lightning.errors import UserError
from mops_lightning.nets import atlasnet, autoencoder, dgcnn, foldingnet, pcrnet, pointnet
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.by_budget import ByBudget
from mops_lightning.zoo import names, weights
from mops_lightning.zoo.construction import Construction
from mops_lightning.zoo.weights import fit_state

M = TypeVar("M", bound=nn.Module)

SEES_CHANNELS = "sees_channels"
"""Whether a method of a ``ByBudget`` was trained on the channels that its file names."""

HINT = "Give a sampler, or the weights of a run with learn=sampler or learn=joint."
NET_HINT = "Give the weights of a task net, such as those of a run with learn=task."
NETS: tuple[type[nn.Module], ...] = (
    pointnet.PointNetVanilla,
    pointnet.PointNetTransform,
    dgcnn.DGCNN,
    pcrnet.PCRNet,
    autoencoder.AutoEncoder,
    atlasnet.AtlasNet,
    foldingnet.MFoldingNet,
)
"""The task nets that files may name."""


@cache
def package_samplers() -> list[type[Sampler]]:
    """Return the samplers that files may name: all of the public API."""
    samplers: list[type[Sampler]] = []
    for name in mops_lightning.__all__:
        public = getattr(mops_lightning, name)
        is_sampler = isinstance(public, type) and issubclass(public, Sampler)
        if is_sampler and public is not Sampler:
            samplers.append(public)
    return samplers


def load(path: str | Path, cls: type[Sampler] | None = None) -> Sampler:
    """Load a trained sampler by its name, or from a weights file.

    Nothing in the file is executed: it holds tensors and plain data, and only samplers of this
    package, or ``cls``, are built. Nothing global is changed, torch's random state included:
    threads may load at the same time.

    Args:
        path: a model's name (``mops-lightning models`` lists them), a weights file, the folder
            of a run, or the address of a weights file, ``https://…#sha256=HASH``.
        cls: the sampler's class, if it is not one of this package.

    Returns:
        The sampler in eval mode on the CPU. It maps points ``(B, N, 3)`` to a ``SampleOutput`` with
        points ``(B, M, 3)``, M being the number of points that it was trained for, or any smaller
        one for a flexible sampler.

    Raises:
        UserError: the file is missing, damaged, not a sampler's, or does not match the sampler.

    Examples:
        >>> import torch
        >>> from mops_lightning import load
        >>> sampler = load("mops.modelnet40-m32")
        >>> sampler(torch.rand(2, 64, 3)).points.shape
        torch.Size([2, 32, 3])
    """
    if not isinstance(path, str | Path):
        raise UserError(f"path must be a string or a Path, got {path!r}.")
    path = weights.of_run(names.resolve(path))
    content = weights.read(path)
    config = content["config"]
    if config.get("learn") == "task":
        raise UserError(f"{path} holds a task net, not a sampler. {HINT}")
    node = config.get("sampler")
    found = cls or _known_class(node, [*package_samplers(), ByBudget])
    if found is None:
        raise UserError(
            f"{path}: sampler._target_ must be a sampler of mops_lightning, got "
            f"{_target(node)!r:.99}. For a sampler of your own, give load() its class: "
            "load(path, cls=MySampler)."
        )
    if _sees_channels(found):
        node = _with_channels(node, content["channels"])
    return _build(found, node, content["state"], path, "sampler", HINT)


def load_net(path: str | Path) -> nn.Module:
    """Load a trained task net by its name, or from a weights file; see ``load``.

    Args:
        path: a model's name, a weights file or the folder of a run that trained a task net.

    Returns:
        The net in eval mode on the CPU, such as a PointNet, which maps points ``(B, N, 3)`` to
        logits ``(B, num_classes)``.

    Raises:
        UserError: the file is missing, damaged, not a task net's, or does not match the net.
    """
    return read_net(path)[0]


def read_net(path: str | Path) -> tuple[nn.Module, list[str]]:
    """Load a trained task net, and the names of its classes; see ``load_net``."""
    path = weights.of_task_net(path)
    content = weights.read(path)
    config = content["config"]
    if config.get("learn") not in ("task", "joint"):
        raise UserError(f"{path} holds a sampler, not a task net. {NET_HINT}")
    node = None
    if isinstance(config.get("task"), dict):
        node = config["task"].get("net")
    net_class: type[nn.Module] | None = _known_class(node, NETS)
    if node is None or net_class is None:
        known = ", ".join(cls.__name__ for cls in NETS)
        raise UserError(f"{path}: task.net must be one of {known}, got {_target(node)!r:.99}.")
    if "num_classes" in signature(net_class).parameters:
        node = {**node, "num_classes": len(content["classes"])}
    node = _with_channels(node, content["channels"])
    state = {name.removeprefix("net."): value for name, value in content["state"].items()}
    net = _build(net_class, node, state, path, "task.net", NET_HINT)
    return net, content["classes"]


def _target(node: Any) -> Any:
    if not isinstance(node, dict):
        return None
    return node.get("_target_")


def _sees_channels(cls: type[Sampler]) -> bool:
    """Return whether a sampler, or a base to which it passes arguments on, takes channels."""
    bases = [base for base in cls.__mro__ if issubclass(base, Sampler)]
    return any("point_channels" in signature(base).parameters for base in bases)


def _with_channels(node: Any, channels: PointChannels) -> Any:
    """Return a node's settings with the channels that its file names."""
    if channels and isinstance(node, dict):
        return {**node, "point_channels": channels}
    return node


def _known_class(node: Any, known: Iterable[type[M]]) -> type[M] | None:
    """Return the class that a file names, if it is one of the known ones."""
    target = _target(node)
    for cls in known:
        if target == f"{cls.__module__}.{cls.__qualname__}":
            return cls
    return None


def _build(
    cls: type[M], node: Any, state: dict[str, Tensor], path: Path, part: str, hint: str
) -> M:
    """Build a module with the arguments (``node``) and the tensors of a file.

    Args:
        cls: its class.
        node: the settings of ``part``, from the file.
        state: the tensors.
        path: the file, for errors.
        part: what the node is called in the file's configuration.
        hint: what to try next, for errors.

    Raises:
        UserError: an argument is not plain or not the class's, or the tensors do not match.
    """
    if not isinstance(node, dict):
        raise UserError(f"{path}: {part} must be a group of settings, got {node!r:.99}.")
    arguments = _arguments(node)

    def make() -> M:
        try:
            with Construction(len(state)):
                if issubclass(cls, ByBudget):
                    return cls(**{**arguments, "samplers": _members(node, path)})
                return cls(**arguments)
        except (TypeError, ValueError, RuntimeError) as error:  # RuntimeError: sizes over 64 bits
            reason = str(error).partition("\n")[0]
            name = f"{cls.__module__}.{cls.__qualname__}"
            raise UserError(f"{path}: cannot build {name}: {reason}") from None

    # Without memory first: a small file can describe a large net.
    with torch.device("meta"):
        bare = make()
    fit_state(bare, state, path, hint, assign=True)
    module = make()
    fit_state(module, state, path, hint)
    return module.eval()


def _arguments(node: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in node.items() if name != "_target_"}


def _members(node: dict[str, Any], path: Path) -> list[Sampler]:
    """Build the samplers of a ``ByBudget``, which have no weights yet.

    Raises:
        UserError: one of them is not a sampler of this package.
    """
    members = node.get("samplers")
    if not isinstance(members, list):
        members = []
    samplers = []
    for member in members:
        cls = _known_class(member, package_samplers())
        if cls is None:
            raise UserError(
                f"{path}: a method must be a sampler of mops_lightning, got "
                f"{_target(member)!r:.99}. {HINT}"
            )
        arguments = _arguments(member)
        if arguments.pop(SEES_CHANNELS, False):
            arguments["point_channels"] = node.get("point_channels", 0)
        samplers.append(cls(**arguments))
    return samplers
