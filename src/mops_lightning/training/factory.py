"""Building the experiment that a configuration describes."""

from dataclasses import replace
from typing import Any

import lightning as L
import torch
from omegaconf import DictConfig, OmegaConf
from torch import nn

from mops_lightning.config.build import accepted, build, settings_named
from mops_lightning.data.clouds import CloudDataset
from mops_lightning.samplers.base import Sampler
from mops_lightning.seeding import derive_seed
from mops_lightning.tasks.base import Task
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.recipe import Recipe
from mops_lightning.training.sizes import sizes_to_test
from mops_lightning.types import Batch


def make_experiment(cfg: DictConfig, dataset: CloudDataset, identity: dict[str, str]) -> Experiment:
    """Build task, sampler and baselines.

    Args:
        cfg: a composed configuration.
        dataset: says how many classes and points there are.
        identity: see ``checkpoint.identity``.

    Raises:
        UserError: a setting that its part or the data do not allow.
    """
    task = _make_task(cfg, len(dataset.class_names))
    # A seed of its own: the sampler's initial weights must not depend on the task net's size.
    L.seed_everything(derive_seed(cfg.seed, 1) % 2**32, verbose=False)
    # For samplers that select points by the task net's features.
    net = {"net": task.net}
    own = accepted(cfg.sampler, net)
    sampler = build(cfg.sampler, "sampler", **own) if cfg.learn != "task" else None
    points = points_per_cloud(task, dataset)
    sizes = sizes_to_test(cfg.sizes, cfg.m, sampler, points, training=cfg.learn != "nothing")
    baselines: dict[str, Sampler] = {}
    if sampler is not None and sampler.learned:
        baselines = _make_baselines(cfg, max(sizes), net)
    elif sampler is not None and sampler.flexible:
        sampler = build(cfg.sampler, "sampler", m=max(sizes), **own)
    _check_cloud_size(cfg, sampler, baselines, points)
    make_optimizer, make_schedule = optimizer_makers(cfg.optimizer)
    if cfg.learn != "nothing":
        _try_optimizer(make_optimizer, make_schedule)
    return Experiment(
        task,
        sampler,
        learn=cfg.learn,
        make_optimizer=make_optimizer,
        make_schedule=make_schedule,
        baselines=baselines,
        seed=cfg.seed,
        identity=identity,
        sizes=sizes,
        m=cfg.m,
        task_lr_scale=cfg.task_lr_scale,
        refine=cfg.refine,
        recipe=_recipe(cfg, sampler),
    )


def points_per_cloud(task: Task, dataset: CloudDataset) -> int:
    """Return the number of points that a sampler gets of every cloud.

    Raises:
        UserError: the data have too few points for the task.
    """
    clouds = Batch(dataset.test.points[:1], dataset.test.labels[:1])
    batch = task.make_batch(clouds, lambda: [torch.Generator()])
    return batch.points.shape[1]


def _recipe(cfg: DictConfig, sampler: Sampler | None) -> Recipe:
    """Return the recipe in force; the task net's training has a record of its own."""
    recipe: Recipe = build(cfg.recipe, "recipe")
    if sampler is None:
        return Recipe(task_points=recipe.task_points)
    return replace(recipe, task_points=None) if sampler.learned else Recipe()


def _make_task(cfg: DictConfig, num_classes: int) -> Task:
    L.seed_everything(derive_seed(cfg.seed, 0) % 2**32, verbose=False)
    net = build(cfg.task.net, "task.net", **accepted(cfg.task.net, {"num_classes": num_classes}))
    return task_with(cfg, net, num_classes)


def task_with(cfg: DictConfig, net: nn.Module, num_classes: int) -> Task:
    """Build the task that a configuration describes, with the given net."""
    return build(cfg.task, "task", net=net, **accepted(cfg.task, {"num_classes": num_classes}))


def _make_baselines(cfg: DictConfig, m: int, net: dict[str, Any]) -> dict[str, Sampler]:
    nodes = {str(name): node for name, node in cfg.baselines.items() if node}
    return {name: _make_baseline(name, node, m, cfg.seed, net) for name, node in nodes.items()}


def _make_baseline(name: str, node: DictConfig, m: int, seed: int, net: dict[str, Any]) -> Any:
    """Build an index sampler for ``m`` points, with the run's seed unless it has its own."""
    own = accepted(node, net if "seed" in node else {**net, "seed": seed})
    return build(node, f"baselines.{name}", m=m, **own)


def _check_cloud_size(
    cfg: DictConfig, sampler: Sampler | None, baselines: dict[str, Sampler], n: int
) -> None:
    """Let samplers refuse clouds of ``n`` points before anything is trained."""
    if sampler is not None:
        with settings_named(cfg.sampler, "sampler", "m"):
            sampler.check_cloud_size(n)
    for name, baseline in baselines.items():
        with settings_named(cfg.baselines[name], f"baselines.{name}", "m", "seed"):
            baseline.check_cloud_size(n)


def _try_optimizer(make_optimizer: Any, make_schedule: Any) -> None:
    """Make an optimizer of nothing, so that its mistakes end a run before a net is pretrained."""
    optimizer = make_optimizer([torch.nn.Parameter(torch.zeros(1))])
    if make_schedule:
        make_schedule(optimizer, total_steps=2)


def optimizer_makers(node: DictConfig) -> tuple[Any, Any]:
    """Return what makes an optimizer of parameters, and a schedule of an optimizer, or None."""
    settings: Any = OmegaConf.to_container(node, resolve=True)
    schedule = settings.pop("schedule", None)
    makers = {"optimizer": settings, "optimizer.schedule": schedule}
    make_optimizer, make_schedule = (
        one and build(OmegaConf.create({**one, "_partial_": True}), where)
        for where, one in makers.items()
    )
    return make_optimizer, make_schedule
