"""Task nets by name or from weights files, without Hydra."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import nn

from mops_lightning.errors import UserError
from mops_lightning.nets.atlasnet import AtlasNet
from mops_lightning.nets.autoencoder import AutoEncoder
from mops_lightning.nets.dgcnn import DGCNN
from mops_lightning.nets.foldingnet import MFoldingNet
from mops_lightning.nets.pcrnet import PCRNet
from mops_lightning.nets.pointnet import PointNetTransform, PointNetVanilla
from mops_lightning.zoo import names, weights
from mops_lightning.zoo.closed_list import ClosedList

NETS: dict[str, type[nn.Module]] = {
    "pointnet": PointNetVanilla,
    "pointnet_transform": PointNetTransform,
    "dgcnn": DGCNN,
    "autoencoder": AutoEncoder,
    "mfoldingnet": MFoldingNet,
    "atlasnet": AtlasNet,
    "pcrnet": PCRNet,
}
"""What ``load_net`` can build, and how tables call it."""

LISTED = ClosedList(
    tuple(NETS.values()),
    "task.net",
    "task net",
    "Nets of your own can be tested with weights=FILE and task/net=NAME.",
)
HINT = "Give the weights of a run with learn=task, or the task_weights.pt of one with learn=joint."


@dataclass(frozen=True)
class LoadedNet:
    """A task net and what its file says about it.

    Attributes:
        net: in evaluation mode, on the CPU.
        kind: its name in ``NETS``.
        content: of the file; see ``weights.read``.
    """

    net: nn.Module
    kind: str
    content: dict[str, Any]


def load_net(path: str | Path, task: str, num_classes: int) -> LoadedNet:
    """Load a task net by its name, or from a weights file.

    Nothing in the file is executed: it holds tensors and plain data, and only task nets of this
    package are built. Torch's random state is left as it is.

    Args:
        path: a model's name, a weights file, or the folder of a run that trained a task net.
        task: name of the task that the net must have been trained for.
        num_classes: of classifiers.

    Raises:
        UserError: the file is missing, damaged, another task's or not a task net's, or its weights
            do not fit the net that it describes.
    """
    path = file_of(path)
    content = weights.read(path)
    config = content["config"]
    if config.get("learn") not in ("task", "joint"):
        raise UserError(f"{path} holds a sampler, not a task net. {HINT}")
    trained_for = below(config, "names").get("task")
    if trained_for != task:
        raise UserError(f"{path} holds a net for {trained_for}, not for {task}. Give a net for it.")
    # The file is a task's, whose only part with weights is the net.
    state = {name.removeprefix("net."): value for name, value in content["state"].items()}
    described = below(config, "task").get("net")
    net = LISTED.build(described, state, path, HINT, num_classes=num_classes)
    kind = next(name for name, cls in NETS.items() if type(net) is cls)
    return LoadedNet(net.eval(), kind, content)


def file_of(given: str | Path) -> Path:
    """Return the file of a task net: that of a run's folder; any other path is the file.

    Args:
        given: what ``names.resolve`` takes, or the folder of a run that trained a task net, alone
            or with a sampler.

    Raises:
        UserError: there is no file and no model of this name, or the folder's record is damaged.
    """
    path = names.resolve(given)
    if not path.is_dir():
        return path
    joint = weights.of_run(path, "task_weights")
    return joint if joint.is_file() else weights.of_run(path)


def below(config: dict[str, Any], name: str) -> dict[str, Any]:
    """Return a part of a file's configuration; an empty one for anything but settings."""
    part = config.get(name)
    return part if isinstance(part, dict) else {}
