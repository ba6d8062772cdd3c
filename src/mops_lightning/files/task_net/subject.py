"""The task whose net is compared: of a run, or a module of the user's own."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor, nn
from torchmetrics import MetricCollection

from mops_lightning.channels import NO_CHANNELS, PointChannels
from mops_lightning.data.crops import Crop
from mops_lightning.errors import UserError, check_at_least, did_you_mean
from mops_lightning.tasks.base import Task
from mops_lightning.types import Batch, TaskOutput

CROPS = {
    "nearest": 8,
    "whole": 1,
}
"""Crops of every file and draw, unless ``--crops`` sets them."""

POINTS = 1024
"""Points of a crop for a module of the user's own, unless ``--points`` sets them."""

Loss = Callable[[Any, Batch], Tensor]
"""Returns the loss of a module's output for a batch: one number, or one for each cloud."""


class OwnTask(Task):
    """A module of the user's own with its loss, which is also its score.

    Args:
        net: maps points ``(B, M, 3)`` to an output.
        loss: see ``Loss``.
    """

    def __init__(self, net: nn.Module, loss: Loss) -> None:
        nn.Module.__init__(self)  # the arguments of the net may have any names
        self.net = net
        self.loss = loss

    def step(self, batch: Batch, points: Tensor) -> TaskOutput:
        """Return the mean loss of a batch.

        Raises:
            UserError: the loss is no number.
        """
        output = self.net(points)
        loss = self.loss(output, batch)
        if not isinstance(loss, Tensor):
            raise self._refused(batch, type(loss).__name__)
        if loss.shape not in ((), (batch.num_clouds,)):
            raise self._refused(batch, str(tuple(loss.shape)))
        return TaskOutput({"loss": loss.mean()}, output, None, output)

    def _refused(self, batch: Batch, found: str) -> UserError:
        return UserError(
            f"loss must return one number, or one for each of {batch.num_clouds} clouds, got "
            f"{found}."
        )

    def metrics(self, training: bool = False) -> MetricCollection:
        """Return no metric: the loss is the score."""
        return MetricCollection({})


@dataclass(frozen=True)
class Subject:
    """A task with its trained net, and the clouds that it sees.

    Attributes:
        name: of the net, for titles and errors.
        task: in evaluation mode.
        outputs: names of the classes or parts that the net tells apart; empty: those of the files.
        channels: of the points.
        n_points: number of points of a cloud.
        crop: how clouds are cut from files; see ``cloud_folder``.
        crops: number of clouds of every file and draw.
        label: column with the parts of points; None without parts.
        config: the settings of the run; empty for a module.
        sampler: weights of the sampler that the run trained, or None.
    """

    name: str
    task: Task
    outputs: tuple[str, ...]
    channels: PointChannels
    n_points: int
    crop: Crop
    crops: int
    label: str | None
    config: dict[str, Any]
    sampler: Path | None

    @property
    def needs_classes(self) -> bool:
        """Whether the files must be in folders of the net's classes."""
        return self.task.output_names == "class_names"

    @property
    def needs_parts(self) -> bool:
        """Whether the files must have a column of the net's parts."""
        return self.task.output_names == "part_names"


def subject_of_run(
    reference: str,
    points: int | None,
    crops: int | None,
    label: str | None,
) -> Subject:
    """Return the task of a run, a model or a weights file.

    Args:
        reference: see ``read_task``.
        points: number of points of a cloud; None: as in training.
        crops: number of clouds of every file and draw; None: see ``CROPS``.
        label: column with the parts of points; None: as in training.

    Raises:
        UserError: there is no such task, or an argument does not fit it.
    """
    from mops_lightning.training.task_net import read_task

    try:
        trained = read_task(reference)
    except UserError as error:
        hint = ""
        if not Path(reference).exists():
            hint = " A net of your own needs --loss, too."
        raise UserError(f"--task-net: {error}{hint}") from None
    data = trained.config["dataset"]
    # Tiles are neighbourhoods, too, but always the same ones.
    crop: Crop = "whole"
    if data.get("crop") in ("nearest", "tiles"):
        crop = "nearest"
    subject = Subject(
        name=reference,
        task=trained.task,
        outputs=trained.outputs,
        channels=trained.channels,
        n_points=points or data.get("n_points") or POINTS,
        crop=crop,
        crops=crops or CROPS[crop],
        label=label or data.get("label"),
        config=trained.config,
        sampler=trained.sampler,
    )
    if subject.needs_parts and subject.label is None:
        raise UserError(f"--label: {reference} needs the column of the files that holds the parts.")
    if label is not None and not subject.needs_parts:
        raise UserError(f"--label is for segmentation, but {reference} tells no parts apart.")
    return subject


def subject_of_module(
    module: nn.Module,
    loss: Loss | None,
    points: int | None,
    crops: int | None,
    label: str | None,
) -> Subject:
    """Return the task of a module of the user's own.

    Args:
        module: a trained net that maps points ``(B, M, 3)`` to an output; in evaluation mode from
            then on.
        loss: see ``Loss``.
        points: number of points of a cloud; None: ``POINTS``.
        crops: number of clouds of every file and draw; None: see ``CROPS``.
        label: column with the parts of points, or None.

    Raises:
        UserError: these are no module and no function.
    """
    if not isinstance(module, nn.Module):
        raise UserError(
            f"task_net must be a run, a model or a torch.nn.Module, got {type(module).__name__}."
        )
    if loss is None or not callable(loss):
        raise UserError(
            "loss must be a function of the net's output and a Batch, as the net is a module of "
            f"your own; got {loss!r:.99}."
        )
    return Subject(
        name=type(module).__name__,
        task=OwnTask(module, loss).eval(),
        outputs=(),
        channels=NO_CHANNELS,
        n_points=points or POINTS,
        crop="nearest",
        crops=crops or CROPS["nearest"],
        label=label,
        config={},
        sampler=None,
    )


def imported(name: str, option: str) -> Any:
    """Return the object with a dotted name; modules are looked for in the current folder, too.

    Args:
        name: such as ``my_net.build``.
        option: that gave it, for errors.

    Raises:
        UserError: it cannot be imported.
    """
    from hydra.utils import get_object

    folders = sys.path
    if "" not in folders and str(Path.cwd()) not in folders:
        sys.path.insert(0, "")
    try:
        return get_object(name)
    except Exception as error:
        lines = str(error.__cause__ or error).strip().splitlines()
        reason = lines[-1]
        module, _, last = name.rpartition(".")
        if module in sys.modules:  # Hydra then says that the module is no package
            hint = did_you_mean(last, vars(sys.modules[module]))
            reason = f"{module} has no {last!r}.{hint}"
        raise UserError(f"{option}: cannot import {name!r}: {reason}") from None


def imported_module(name: str) -> nn.Module:
    """Return the net that a dotted name means: a module, or what a function or class returns.

    Raises:
        UserError: it is something else.
    """
    found = imported(name, "--task-net")
    if not isinstance(found, nn.Module) and callable(found):
        try:
            found = found()
        except TypeError as error:
            raise UserError(f"--task-net: {name}() fails: {error}") from None
    if not isinstance(found, nn.Module):
        raise UserError(
            f"--task-net: {name} must be a torch.nn.Module, or return one; got "
            f"{type(found).__name__}."
        )
    return found


def check_numbers(points: int | None, crops: int | None, draws: int) -> None:
    """Check the numbers of a comparison.

    Raises:
        UserError: one is out of range.
    """
    check_at_least(1, **{"--draws": draws})
    if points is not None:
        check_at_least(2, **{"--points": points})
    if crops is not None:
        check_at_least(1, **{"--crops": crops})
