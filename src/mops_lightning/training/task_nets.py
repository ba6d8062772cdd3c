"""Loading the task nets of ``task_nets``, which had no part in the training of the sampler."""

from collections import Counter
from typing import Any

from omegaconf import DictConfig
from torch import nn

from mops_lightning.data.clouds import CloudDataset
from mops_lightning.errors import UserError
from mops_lightning.records.readout_names import FULL
from mops_lightning.tasks.base import Task
from mops_lightning.training.evaluate import same_attributes, same_classes
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.factory import task_with
from mops_lightning.training.scores import TransferScores
from mops_lightning.zoo.nets import LoadedNet, below, load_net

KEY = "task_nets"


def add_task_nets(experiment: Experiment, cfg: DictConfig, dataset: CloudDataset) -> dict[str, Any]:
    """Load the nets that ``task_nets`` names, so that tests score the samples under them, too.

    Args:
        experiment: of the evaluated sampler.
        cfg: a composed configuration with ``task_nets``.
        dataset: the data that are scored.

    Returns:
        Notes for the record: what each net's file says about it, by the net's label.

    Raises:
        UserError: a file does not hold a net of this task and these classes, or two files hold the
            same net.
    """
    files = {str(path): _load(str(path), experiment, cfg, dataset) for path in cfg[KEY]}
    if len(files) < len(cfg[KEY]):
        raise UserError(f"{KEY} must name each net once, got {', '.join(cfg[KEY])}.")
    labels = _labels(files)
    number = len(dataset.class_names)
    tasks = {label: _task(cfg, files[path].net, number, path) for label, path in labels.items()}
    experiment.transfer = TransferScores(tasks, experiment.scores.readouts)
    score = experiment.task.full_score or experiment.task.score
    return {label: {"file": path, **_facts(files[path], score)} for label, path in labels.items()}


def _load(path: str, experiment: Experiment, cfg: DictConfig, dataset: CloudDataset) -> LoadedNet:
    try:
        found = load_net(path, cfg.names.task, len(dataset.class_names))
        same_attributes(found.content["config"], dataset, path)
        # As for the task net of a run: files of early versions do not name their classes.
        if experiment.task.requires_same_classes and found.content["classes"]:
            same_classes(found.content["classes"], dataset, path)
    except UserError as error:
        raise UserError(f"{KEY}: {error}") from None
    return found


def _task(cfg: DictConfig, net: nn.Module, num_classes: int, path: str) -> Task:
    try:
        return task_with(cfg, net, num_classes)
    except UserError as error:  # a net of another task under this one's name
        raise UserError(f"{KEY}: {path}: {error}") from None


def _labels(files: dict[str, LoadedNet]) -> dict[str, str]:
    """Return the files by the labels of their nets: kind and seed, and the hash where needed.

    Raises:
        UserError: two files hold the same net.
    """
    names = {path: f"{one.kind} seed {_seed(one)}" for path, one in files.items()}
    counts = Counter(names.values())
    labels: dict[str, str] = {}
    for path, name in names.items():
        sha256 = files[path].content["sha256"]
        label = name if counts[name] == 1 else f"{name} ({sha256[:8]})"
        if label in labels:
            raise UserError(
                f"{KEY} must name each net once: {labels[label]} and {path} hold the same one."
            )
        labels[label] = path
    return labels


def _seed(net: LoadedNet) -> int | str:
    seed = net.content["config"].get("seed")
    return seed if type(seed) is int else "unknown"


def _facts(net: LoadedNet, score: str) -> dict[str, Any]:
    """Return what a net's file says about the net and its training."""
    config, metrics = net.content["config"], net.content["metrics"]
    recorded = metrics.get(f"test/{FULL}/{score}") if isinstance(metrics, dict) else None
    return {
        "net": net.kind,
        "seed": _seed(net),
        "sha256": net.content["sha256"],
        "learn": config["learn"],
        "max_epochs": below(config, "trainer").get("max_epochs"),
        "dataset": below(config, "names").get("dataset"),
        "recorded_score": float(recorded) if isinstance(recorded, int | float) else None,
    }
