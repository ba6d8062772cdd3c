"""Samplers by name or from weights files, without Hydra."""

from pathlib import Path

from mops_lightning.errors import UserError
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.critical_points import CriticalSampler
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
from mops_lightning.zoo.closed_list import ClosedList

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
"""What ``load`` can build."""

LISTED = ClosedList(
    SAMPLERS,
    "sampler",
    "sampler",
    "For a sampler of your own, build it and call mops_lightning.zoo.weights.load_into.",
)

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
    config = content["config"]
    if config.get("learn") == "task":
        raise UserError(f"{path} holds a task net, not a sampler. {HINT}")
    sampler: Sampler = LISTED.build(config.get("sampler"), content["state"], path, HINT)
    return sampler.eval()
