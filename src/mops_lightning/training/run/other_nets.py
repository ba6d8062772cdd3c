"""Task nets from files: further ones that a sampler is trained under, and their classes."""

from omegaconf import DictConfig

from mops_lightning.config.build import build_as, takes
from mops_lightning.data.clouds import CloudDataset
from mops_lightning.errors import UserError
from mops_lightning.tasks.base import Task
from mops_lightning.zoo.outputs import check_names


def other_tasks(cfg: DictConfig, dataset: CloudDataset) -> list[Task]:
    """Build the run's task with each net of ``other_nets``.

    Raises:
        UserError: a file holds no task net, or one of another task or of other classes; or
            ``recipe.nets_per_step`` is more than there are.
    """
    names = list(cfg.other_nets or ())
    drawn = cfg.recipe.nets_per_step or 0
    if drawn > len(names):
        raise UserError(
            f"recipe.nets_per_step={drawn}: there are {len(names)} other_nets. Give more, or null."
        )
    if cfg.learn != "sampler":
        return []
    try:
        return [_task_with_net(name, cfg, dataset) for name in names]
    except UserError as error:
        raise UserError(f"other_nets: {error}") from None


def _task_with_net(name: str, cfg: DictConfig, dataset: CloudDataset) -> Task:
    """Build the run's task with the net of a file, a model or a run."""
    from mops_lightning.zoo.load import read_net  # imports every net

    if takes(cfg.task, "num_parts"):
        raise UserError("no file can name a net of segmentation. Leave other_nets out.")
    net, classes = read_net(name)
    offered = {
        "num_classes": len(dataset.class_names),
        "point_channels": dataset.channels,
    }
    task: Task = build_as(Task, cfg.task, "task", offered, net=net)
    check_names(classes, task, dataset, name)
    return task
