"""The first stage of a run whose parts are built: weights from files, which must fit."""

from pathlib import Path

import torch

from mops_lightning.data.clouds import CloudDataset
from mops_lightning.errors import UserError
from mops_lightning.records.run_record import Evaluated, RunRecord
from mops_lightning.training.checkpoint import CHECKPOINT, read_sealed
from mops_lightning.training.evaluation import KEY, OF_RUN, TrainedRun
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.run.build import Parts
from mops_lightning.zoo import weights


def load_weights(parts: Parts, record: RunRecord, task_weights: Path | None) -> None:
    """Load the weights of the task net and of an evaluated run.

    Raises:
        UserError: they do not fit.
    """
    task = parts.experiment.task
    if task_weights is not None:
        try:
            content = weights.load_into(task, task_weights)
        except UserError as error:
            raise UserError(f"weights: {error}") from None
        record.weights_loaded = content["sha256"]
        if task.requires_same_classes and content.get("classes"):
            check_classes(content["classes"], parts.dataset, f"weights: {task_weights}")
    if parts.trained is not None:
        of_run = parts.cfg.weights == OF_RUN
        record.evaluated = load_trained(parts.trained, of_run, parts.experiment, parts.dataset)


def load_trained(
    trained: TrainedRun, task_net: bool, experiment: Experiment, dataset: CloudDataset
) -> Evaluated:
    """Load the nets of a trained run into an experiment.

    Args:
        trained: the run.
        task_net: whether the run's task net is loaded, if it has weights.
        experiment: to fill.
        dataset: that is tested.

    Returns:
        The run and how it was trained, for the record.

    Raises:
        UserError: settings, classes or files do not match the run.
    """
    record, name = trained.record, trained.name
    own_data = record.dataset_fingerprint == dataset.fingerprint
    if experiment.task.requires_same_classes and task_net and not own_data:
        check_classes(record.class_names, dataset, f"{KEY}: {name}")
    part = "task net" if trained.trained_task_net else "sampler"
    module = experiment.task if trained.trained_task_net else experiment.sampler
    assert module is not None  # learn=nothing builds a sampler
    try:
        content = weights.load_into(module, weights.of_run(trained.place))
    except UserError as error:
        raise UserError(f"{KEY}: the {part} of {name} cannot be loaded: {error}") from None
    has_weights = any(True for _ in experiment.task.parameters())
    if task_net and has_weights and not trained.trained_task_net:
        try:
            _load_task(experiment.task, trained)
        except UserError as error:
            raise UserError(f"{KEY}: {error}") from None
    return Evaluated(
        run=name,
        commit=record.git["commit"],
        max_epochs=record.config["trainer"]["max_epochs"],
        learn=record.config["learn"],
        recipe=record.recipe,
        seed=record.seed,
        dataset=record.config["names"]["dataset"],
        weights_sha256=content["sha256"],
    )


def check_classes(names: list[str] | None, dataset: CloudDataset, what: str) -> None:
    """Reject a net whose class numbers differ from the data's.

    Args:
        names: the classes that the net was trained on; None if unknown.
        dataset: the data.
        what: the file or folder of the net.

    Raises:
        UserError: they differ, or are unknown.
    """
    classes = list(dataset.class_names)
    if names is None:
        raise UserError(
            f"{what} does not name the classes of its net, so it can be used with its own data "
            "only."
        )
    if list(names) != classes:
        missing = [name for name in names if name not in classes] or list(names)
        raise UserError(
            f"{what}: its net has {len(names)} classes, which are not the {len(classes)} classes "
            f"of the data: {', '.join(missing[:3])} ... instead of {', '.join(classes[:3])} .... "
            "Give a task net of these classes with weights=auto, or data of its classes with "
            "dataset.classes."
        )


def _load_task(task: torch.nn.Module, trained: TrainedRun) -> None:
    """Load the task net from a jointly trained run's weights, or from the run's checkpoint."""
    place = trained.place
    if "task_weights" in trained.record.files:
        weights.load_into(task, weights.of_run(place, "task_weights"))
        return
    if place.is_file():
        raise UserError(f"the model {place.stem} comes without its task net. Give weights=FILE.")
    path = place / "checkpoints" / CHECKPOINT
    if not path.is_file():
        raise UserError(
            f"{path}, which contains the run's task net, does not exist. Give weights=FILE."
        )
    state = read_sealed(path)["state_dict"]
    own = {
        key.removeprefix("task."): value for key, value in state.items() if key.startswith("task.")
    }
    if weights.digest(own) != trained.record.task_weights_sha256:
        raise UserError(f"{path} does not belong to the run in its folder. Give weights=FILE.")
    weights.fit_state(task, own, path)
