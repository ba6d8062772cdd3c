"""The task net of a trained run, with its task, outside of a run."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mops_lightning.channels import PointChannels
from mops_lightning.config.compose import compose
from mops_lightning.errors import UserError
from mops_lightning.records import run_record
from mops_lightning.records.run_record import RunRecord
from mops_lightning.tasks.base import Task
from mops_lightning.training.as_trained import as_trained
from mops_lightning.training.evaluation import TrainedRun
from mops_lightning.training.run.make_experiment import build_task
from mops_lightning.zoo import model_file, names, weights


@dataclass(frozen=True)
class TrainedTask:
    """A task with its trained net.

    Attributes:
        task: in evaluation mode, without gradients.
        outputs: names of the classes or the parts that the net tells apart; empty for others.
        channels: of the points that the net sees.
        config: the settings of the run, as plain data.
        sampler: the weights that the run trained, if these are a sampler's.
    """

    task: Task
    outputs: tuple[str, ...]
    channels: PointChannels
    config: dict[str, Any]
    sampler: Path | None


def read_task(reference: str) -> TrainedTask:
    """Build the task of a run with its trained net.

    Nothing in a file is executed: as for ``evaluate=RUN``, classes come from the presets that the
    run was composed of.

    Args:
        reference: the folder of a run, a model's name, or a weights file.

    Raises:
        UserError: there is no such run, it did not keep its task net, or it names classes of the
            user's own.
    """
    trained = _trained_run(reference)
    is_task_net = trained.trained_task_net or _is_task_net(trained.path)
    if is_task_net:
        path = weights.of_run(trained.path)
    else:
        path = _task_weights(trained)
    content = weights.read(path)
    record = trained.record
    outputs = {
        "num_classes": len(content["classes"]),
        "num_parts": len(content["classes"]),
    }
    cfg = as_trained(compose(trained.choices()), trained, trained.choices())
    task = build_task(cfg, outputs, content["channels"])
    weights.fit_state(task, content["state"], path)
    sampler = None
    if not is_task_net and weights.read(weights.of_run(trained.path))["state"]:
        sampler = weights.of_run(trained.path)
    return TrainedTask(
        task.eval().requires_grad_(False),
        tuple(content["classes"]),
        content["channels"],
        record.config,
        sampler,
    )


def _trained_run(reference: str) -> TrainedRun:
    """Return a run or a model; a weights file alone stands for the run in its header."""
    place = names.resolve(reference)
    if place.is_file() and place.parent.joinpath(run_record.FILE).is_file():
        record = run_record.read(place.parent)
        if place.name in record.files.values():
            place = place.parent
    if place.is_file() and place.name != run_record.FILE:
        header = model_file.read_header(place)
        if header["schema"] == model_file.WEIGHTS:
            config = header["config"]
            record = _record_of(config, place)
            return TrainedRun(reference, place, record)
    try:
        return TrainedRun.read(str(place))
    except UserError as error:
        raise UserError(str(error).removeprefix("evaluate: ")) from None


def _record_of(config: dict[str, Any], place: Path) -> RunRecord:
    """Return a record of the run that wrote a weights file.

    Raises:
        UserError: the file's configuration is not a run's.
    """
    plain = RunRecord.begin(config, [], 0).plain()
    try:
        record = run_record.from_plain(plain)
    except ValueError:
        raise model_file.damaged(place, "no configuration of a run") from None
    record.status = "completed"
    record.files = {"weights": place.name}
    return record


def _task_weights(trained: TrainedRun) -> Path:
    """Return the file with the weights of the task net that a sampler was trained for.

    Raises:
        UserError: the run kept none.
    """
    if "task_weights" not in trained.record.files:
        raise UserError(
            f"{trained.name} holds a sampler without its task net. Give the folder of its run, or "
            "a task net."
        )
    return weights.of_run(trained.path, "task_weights")


def _is_task_net(place: Path) -> bool:
    """Return whether a weights file of a sampler's run holds the task net beside the sampler."""
    if not place.is_file() or model_file.read_header(place)["schema"] != model_file.WEIGHTS:
        return False
    return all(name.startswith("net.") for name in weights.read(place)["state"])
