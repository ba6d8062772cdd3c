"""Channels of the data: scaled as given nets were trained, and refused where nothing takes them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from mops_lightning.data.clouds import CloudDataset
from mops_lightning.errors import UserError
from mops_lightning.samplers.base import Sampler
from mops_lightning.training.evaluation import EVALUATE, TrainedRun, names_a_net
from mops_lightning.zoo import model_file, names, weights


@dataclass(frozen=True)
class GivenNet:
    """A trained net that a run starts from or tests.

    Attributes:
        setting: the setting that names it.
        reference: what the setting says.
        find: returns the weights file of a reference.
    """

    setting: str
    reference: Any
    find: Callable[[Any], Path]


def scaled_as_trained(
    dataset: CloudDataset, cfg: DictConfig, trained: TrainedRun | None
) -> CloudDataset:
    """Return the data with the channels' statistics of the nets that the run is given.

    Without given nets, the statistics are those of the training split.

    Args:
        dataset: the loaded data.
        cfg: the run's settings.
        trained: the run that is evaluated.

    Raises:
        UserError: a net was trained with other features, or two nets with other statistics.
    """
    first = None
    for net in _given_nets(cfg, trained):
        try:
            path = net.find(net.reference)
            channels = weights.channels_in(model_file.read_header(path))
        except UserError:
            continue  # loading the net will say what is wrong
        if first is not None and channels != first:
            raise UserError(
                f"{net.setting}: {path} was trained with other statistics of the channels than the "
                "net before it. Give nets that were trained on the same data."
            )
        first = channels
        dataset = dataset.scaled_as(channels, f"{net.setting}: {path}")
    return dataset


def _given_nets(cfg: DictConfig, trained: TrainedRun | None) -> Iterator[GivenNet]:
    """Yield the trained nets that a run starts from or tests."""
    if trained is not None:
        yield GivenNet(EVALUATE, trained.path, weights.of_run)
    if names_a_net(cfg.weights):
        yield GivenNet("weights", cfg.weights, weights.of_task_net)
    if cfg.pretrain_from and cfg.weights == "auto":
        yield GivenNet("pretrain_from", cfg.pretrain_from, weights.of_task_net)
    for name in cfg.other_nets or ():
        yield GivenNet("other_nets", name, weights.of_task_net)
    start = None
    if cfg.recipe:
        start = cfg.recipe.get("warm_start")
    if isinstance(start, str):
        yield GivenNet("recipe.warm_start", start, _of_sampler)


def _of_sampler(reference: str) -> Path:
    return weights.of_run(names.resolve(reference))


def check_sampler(sampler: Sampler | None, dataset: CloudDataset) -> None:
    """Refuse channels for a learned sampler that cannot take them."""
    if sampler is None or sampler.channels_of_input in (None, len(dataset.channels)):
        return
    check_without_channels(f"sampler: {type(sampler).__name__}", dataset)


def check_without_channels(part: str, dataset: CloudDataset) -> None:
    """Refuse channels for a part of a run that has no argument for them.

    Args:
        part: the setting and what it chooses, for the error.
        dataset: the data.
    """
    if dataset.channels:
        raise UserError(
            f"{part} takes x, y and z only, but dataset.features gives "
            f"{', '.join(dataset.channels.features)}. Choose another, add an argument "
            "point_channels to it, or leave features out."
        )
