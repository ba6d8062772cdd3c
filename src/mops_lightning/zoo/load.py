"""Samplers by name or from weights files, without Hydra."""

from pathlib import Path
from typing import Any

import torch

from mops_lightning.errors import UserError
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.critical import CriticalSampler
from mops_lightning.samplers.fmops import FMOPSNet
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.samplers.gumbel import GumbelSampler
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.samplers.poisson import PoissonSampler
from mops_lightning.samplers.random import RandomSampler
from mops_lightning.samplers.samplenet import ProgressiveSampleNet, SampleNet
from mops_lightning.samplers.snet import ProgressiveSNet, SNet
from mops_lightning.samplers.submodular import SubmodularSampler
from mops_lightning.samplers.voxel import VoxelSampler
from mops_lightning.zoo import names, weights

SAMPLERS: tuple[type[Sampler], ...] = (
    MOPSNet,
    FMOPSNet,
    SNet,
    ProgressiveSNet,
    SampleNet,
    ProgressiveSampleNet,
    GumbelSampler,
    RandomSampler,
    VoxelSampler,
    FPSSampler,
    PoissonSampler,
    SubmodularSampler,
    CriticalSampler,
)
"""What ``load`` can build. A file's ``_target_`` is compared with this list and never imported."""

HINT = "Give a sampler, or the weights.pt of a run with learn=sampler or learn=joint."


def load(path: str | Path) -> Sampler:
    """Load a trained sampler by its name, or from a weights file.

    Nothing in the file is executed: it holds tensors and plain data, and only samplers of this
    package are built. Torch's random state is left as it is.

    Args:
        path: a model's name (``mops-lightning models`` lists them), a weights file, the folder of
            a run, or ``hf://OWNER/REPO/FILE.safetensors@sha256:HASH``.

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
    path = names.resolve(path)
    path = weights.of_run(path) if path.is_dir() else path
    if not path.is_file():
        raise UserError(f"no file {path}. Give a model, a weights.pt or the folder of its run.")
    content = weights.read(path)
    sampler = _build(content["config"], path)
    weights.fit_state(sampler, content["state"], path, HINT)
    return sampler.eval()


def _build(config: dict[str, Any], path: Path) -> Sampler:
    """Build the untrained sampler that a file's configuration describes."""
    if config.get("learn") == "task":
        raise UserError(f"{path} holds a task net, not a sampler. {HINT}")
    node = config.get("sampler") or {}
    if not isinstance(node, dict) or not all(isinstance(name, str) for name in node):
        raise UserError(
            f"{path}: its setting sampler must be a group of settings, got {node!r:.99}."
        )
    arguments = dict(node)
    target = arguments.pop("_target_", None)
    classes = {f"{cls.__module__}.{cls.__qualname__}": cls for cls in SAMPLERS}
    if not isinstance(target, str) or target not in classes:
        raise UserError(
            f"{path}: sampler._target_ must be a sampler of mops_lightning, got {target!r}. "
            "For a sampler of your own, build it and call mops_lightning.zoo.weights.load_into."
        )
    for name, value in arguments.items():
        if not _is_plain(value):
            raise UserError(
                f"{path}: sampler.{name} must be a number, a string, a list of them or null, "
                f"got {type(value).__name__}."
            )
    try:
        with torch.random.fork_rng(devices=[]):  # the initial weights are replaced at once
            return classes[target](**arguments)
    except (TypeError, UserError) as error:
        raise UserError(f"{path}: cannot build {target}: {error}") from None


def _is_plain(value: Any) -> bool:
    if isinstance(value, list):
        return all(item is not None and _is_plain(item) for item in value)
    return value is None or isinstance(value, bool | int | float | str)
