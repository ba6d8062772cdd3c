"""The experiment of a run: task, sampler and baselines, from their settings and the data.

Besides the settings of its node, a constructor is offered these values, by argument name. (The last
five rows are offered by ``trainer``, ``callbacks`` and ``loggers``.)

| argument | of | value |
|---|---|---|
| ``num_classes`` | task, task net | number of classes of the data |
| ``num_parts`` | task, task net | number of parts that the points of the data belong to |
| ``net`` | task, samplers, baselines | the task net |
| ``point_channels`` | task, task net, sampler | channels of the points, see ``channels`` |
| ``seed`` | baselines | the run's seed, unless the node sets one |
| ``m`` | baselines, untrained samplers | the largest tested size |
| ``folder``, ``checkpoint`` | callbacks | the run's folder, its checkpoint |
| ``score`` | callbacks, logger | name of the task's score |
| ``batch``, ``titles`` | callbacks | the pictured test clouds and their classes |
| ``channels`` | callbacks | channels of the pictured clouds |
| ``name``, ``save_dir`` | loggers | empty, the run's folder |
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import lightning as L
import torch
from omegaconf import DictConfig
from torch import Tensor, nn

from mops_lightning.channels import PointChannels
from mops_lightning.config import settings
from mops_lightning.config.build import build_as, takes
from mops_lightning.config.declaration import Training
from mops_lightning.data.clouds import CloudDataset, check_parts
from mops_lightning.errors import UserError
from mops_lightning.samplers.base import Sampler
from mops_lightning.seeding import derive_seed
from mops_lightning.tasks.base import Task
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.recipe.recipe import Recipe
from mops_lightning.training.run.channels import check_sampler, check_without_channels
from mops_lightning.training.run.cloud_sizes import smallest_cloud
from mops_lightning.training.run.optimizers import OptimizerMakers, check_optimizers
from mops_lightning.training.run.other_nets import other_tasks
from mops_lightning.training.run.sample_sizes import sizes_to_test


def make_experiment(cfg: DictConfig, dataset: CloudDataset, identity: dict[str, str]) -> Experiment:
    """Build task, sampler and baselines.

    Args:
        cfg: a composed configuration.
        dataset: says how many classes and points there are.
        identity: see ``checkpoint_identity``.

    Raises:
        UserError: a setting that its part or the data do not allow.
    """
    _seed_everything(cfg.seed, 0)
    task = _make_task(cfg, dataset)
    # Another seed: the sampler's initial weights must not depend on the task net's size.
    _seed_everything(cfg.seed, 1)
    sampler: Sampler | None = None
    if cfg.learn != "task":
        sampler = _make_sampler(cfg.sampler, dataset, task)
        check_sampler(sampler, dataset)
        if cfg.learn != "nothing":
            _check_learns(cfg, sampler, task)
    cloud = smallest_cloud((dataset.test, dataset.train), task.make_batch)
    trains = cfg.learn != "nothing"
    sizes = sizes_to_test(cfg.sizes, cfg.m, sampler, cloud.shape[1], training=trains)
    baselines: dict[str, Sampler] = {}
    others: Sequence[Task] = ()
    if sampler is not None and sampler.learned:
        baselines = _make_baselines(cfg.baselines, max(sizes), task, cfg.seed)
        _try_baselines(baselines, cloud)
        others = other_tasks(cfg, dataset)
    elif sampler is not None and sampler.flexible:
        sampler = _make_sampler(cfg.sampler, dataset, task, m=max(sizes))
    check_optimizers(cfg)
    makers = OptimizerMakers.of(cfg.optimizer, "optimizer")
    recipe = build_as(Recipe, cfg.recipe, "recipe")
    return Experiment(
        task,
        sampler,
        learn=cfg.learn,
        make_optimizer=makers.optimizer,
        make_schedule=makers.schedule,
        baselines=baselines,
        seed=cfg.seed,
        identity=identity,
        sizes=sizes,
        m=cfg.m,
        task_lr_scale=cfg.task_lr_scale,
        other_tasks=others,
        test_logger=False,  # stages.test logs them, as one table
        recipe=_applicable(recipe, sampler, cfg.learn),
    )


def _seed_everything(seed: int, number: int) -> None:
    """Seed all generators for the initial weights of one part of the run, by its number."""
    L.seed_everything(derive_seed(seed, number) % 2**32, verbose=False)


def _make_task(cfg: DictConfig, dataset: CloudDataset) -> Task:
    """Build the task and its net for the classes or parts of the data.

    Raises:
        UserError: net, task and data do not fit each other.
    """
    offered = {
        "num_classes": len(dataset.class_names),
        "num_parts": len(dataset.part_names),
    }
    _check_fits(cfg, dataset, offered)
    if not takes(cfg.task.net, "point_channels"):
        check_without_channels(f"task/net={cfg.names.net}", dataset)
    return build_task(cfg, offered, dataset.channels)


def build_task(cfg: DictConfig, outputs: Mapping[str, int], channels: PointChannels) -> Task:
    """Build a task and its net, without weights.

    Args:
        cfg: a composed configuration.
        outputs: ``num_classes`` and ``num_parts``.
        channels: channels of the points.

    Raises:
        UserError: a setting that the task or its net does not allow.
    """
    of_data: dict[str, Any] = {**outputs, "point_channels": channels}
    net = build_as(nn.Module, cfg.task.net, "task.net", of_data)
    task: Task = build_as(Task, cfg.task, "task", of_data, net=net)
    return task


def _check_fits(cfg: DictConfig, dataset: CloudDataset, offered: Mapping[str, int]) -> None:
    """Refuse a net of another task, and data without the parts that a task needs.

    Raises:
        UserError: net, task and data do not fit each other.
    """
    of_task = [name for name in offered if takes(cfg.task, name)]
    of_net = [name for name in offered if takes(cfg.task.net, name)]
    takes_the_same = not set(of_task).isdisjoint(of_net)
    if of_task and of_net and not takes_the_same:
        raise UserError(
            f"task/net={cfg.names.net} takes {', '.join(of_net)}, but task={cfg.names.task} gives "
            f"{', '.join(of_task)}. Choose a net of this task (docs/tasks.md)."
        )
    if "num_parts" not in of_task:
        return
    if cfg.test_corruption and dataset.test.parts is None:
        raise UserError(
            f"test_corruption={cfg.test_corruption} adds or removes points, whose parts nobody "
            "knows. Give jitter, rotation, scaling, shear or distortion."
        )
    check_parts(dataset)


def _check_learns(cfg: DictConfig, sampler: Sampler, task: Task) -> None:
    """Refuse a sampler that learns nothing from the task.

    Raises:
        UserError: no loss of the task depends on the sampler.
    """
    if sampler.predicts_residuals and not task.knows_residuals:
        raise UserError(
            f"sampler={cfg.names.sampler} learns residuals of scans, which only task=icp knows; "
            f"got task={cfg.names.task}. Choose task=icp or another sampler."
        )


def _make_sampler(node: DictConfig, dataset: CloudDataset, task: Task, **size: int) -> Sampler:
    """Build the sampler, with the task net if it selects points by this net's features.

    Args:
        node: the sampler's settings.
        dataset: says which channels there are.
        task: owns the task net.
        **size: ``m``, in place of the setting's.
    """
    offered = {"net": task.net, "point_channels": dataset.channels}
    sampler: Sampler = build_as(Sampler, node, "sampler", offered, **size)
    return sampler


def _applicable(recipe: Recipe, sampler: Sampler | None, learn: str) -> Recipe:
    """Return the settings of a recipe that apply to what the run trains.

    The training of the task net before the sampler's is a run of its own, with its own record.
    """
    if sampler is None:
        return Recipe(task_points=recipe.task_points)
    if sampler.learned:
        return replace(recipe, task_points=None)
    if learn != "joint":
        return Recipe()
    # A task net that is trained on the sampler's points sees as many clouds as with a learned one.
    kept = {}
    for name, value in asdict(recipe).items():
        if settings.of(f"recipe.{name}").is_of(Training.JOINT):
            kept[name] = value
    return Recipe(**kept)


def _make_baselines(nodes: DictConfig, m: int, task: Task, seed: int) -> dict[str, Sampler]:
    """Build the index samplers for ``m`` points, with the run's seed unless they have their own."""
    baselines: dict[str, Sampler] = {}
    for name, node in nodes.items():
        if not node:
            continue
        offered: dict[str, Any] = {"net": task.net}
        if "seed" not in node:
            offered["seed"] = seed
        baselines[str(name)] = build_as(Sampler, node, f"baselines.{name!s}", offered, m=m)
    return baselines


@torch.no_grad()
def _try_baselines(baselines: dict[str, Sampler], points: Tensor) -> None:
    """Sample one cloud, so that a mistake ends the run before its training, not in its test."""
    for name, baseline in baselines.items():
        try:
            baseline.eval()(points)
        except UserError as error:
            raise UserError(f"baselines.{name}: {error}") from None
