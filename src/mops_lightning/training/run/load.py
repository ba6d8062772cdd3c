"""Loading weights into the nets of a run: of its task net, and of a run that is evaluated."""

from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from mops_lightning.data.clouds import CloudDataset
from mops_lightning.errors import UserError
from mops_lightning.nets.by_run import BY_RUN
from mops_lightning.records.run_record import Evaluated, RunRecord
from mops_lightning.training.evaluation import EVALUATE, OF_RUN, TrainedRun
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.run.partial import note_evaluated, note_task_net
from mops_lightning.training.run.parts import Parts, has_weights
from mops_lightning.tree import dotted
from mops_lightning.zoo import weights
from mops_lightning.zoo.outputs import check_names


def load_weights(parts: Parts, record: RunRecord, task_weights: Path | None) -> None:
    """Load the weights of the task net and of an evaluated run.

    Raises:
        UserError: they do not fit.
    """
    if task_weights is not None:
        _load_task_net(parts, record, task_weights)
    if parts.trained is not None:
        with_task_net = parts.cfg.weights == OF_RUN
        record.evaluated = load_trained(
            parts.trained, with_task_net, parts.experiment, parts.dataset
        )
        note_evaluated(parts.trained.name, parts.trained.record, record)


def _load_task_net(parts: Parts, record: RunRecord, path: Path) -> None:
    """Load the task net from a file, and say in which settings its training differed."""
    task = parts.experiment.task
    cfg = parts.cfg
    setting = "weights"
    if cfg.learn == "task" and cfg.weights == "auto":
        setting = "pretrain_from"
    try:
        content = weights.load_into(task, path)
    except UserError as error:
        raise UserError(f"{setting}: {error}") from None
    record.weights_loaded = content["sha256"]
    if content.get("classes"):
        check_names(content["classes"], task, parts.dataset, f"{setting}: {path}")
    net: Any = OmegaConf.to_container(cfg.task.net, resolve=True)
    different = _changed_settings(content["config"], net)
    if different and parts.trainer.is_global_zero:
        print(f"{setting}: {path} was trained with {', '.join(different)}, not as here.")
    note_task_net(content["config"], record)


def _changed_settings(recorded: dict[str, Any], net: dict[str, Any]) -> list[str]:
    """Return the recorded settings of a task net that differ from the present ones.

    Args:
        recorded: the configuration of the run that trained the net.
        net: the present settings of the net.
    """
    before = dotted(recorded)
    different = []
    for name, value in dotted(net).items():
        path = f"task.net.{name}"
        if name in BY_RUN or path not in before:
            continue
        if before[path] != value:
            different.append(f"{path}={before[path]}")
    return different


def load_trained(
    trained: TrainedRun, with_task_net: bool, experiment: Experiment, dataset: CloudDataset
) -> Evaluated:
    """Load the nets of a trained run into an experiment.

    Args:
        trained: the run.
        with_task_net: whether the run's task net is loaded, if it has weights.
        experiment: the experiment whose nets are filled.
        dataset: the data to test on.

    Returns:
        The run and how it was trained, for the record.

    Raises:
        UserError: settings, classes or files do not match the run.
    """
    record = trained.record
    task = experiment.task
    is_on_same_data = record.dataset_fingerprint == dataset.fingerprint
    if with_task_net and not is_on_same_data:
        outputs = getattr(record, str(task.output_names), None)
        check_names(outputs, task, dataset, f"{EVALUATE}: {trained.name}")
    module = task if trained.trained_task_net else experiment.sampler
    assert module is not None  # learn=nothing builds a sampler
    needs_task_net = with_task_net and not trained.trained_task_net and has_weights(task)
    try:
        content = weights.load_into(module, weights.of_run(trained.path))
        if needs_task_net:
            if "task_weights" not in record.files:
                raise UserError("it comes without its task net. Give weights=FILE.")
            weights.load_into(task, weights.of_run(trained.path, "task_weights"))
    except UserError as error:
        raise UserError(f"{EVALUATE}: {trained.name} cannot be loaded: {error}") from None
    return Evaluated(
        run=trained.name,
        commit=record.git["commit"],
        max_epochs=record.config["trainer"]["max_epochs"],
        learn=record.config["learn"],
        recipe=record.recipe,
        seed=record.seed,
        dataset=record.config["names"]["dataset"],
        weights_sha256=content["sha256"],
    )
