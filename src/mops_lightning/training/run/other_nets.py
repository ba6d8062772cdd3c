"""Task nets from files: further ones that a sampler is trained under, and their classes."""

from omegaconf import DictConfig

from mops_lightning.config.build import accepted, build_as
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
    drawn, given = cfg.recipe.nets_per_step or 0, len(cfg.other_nets or ())
    if drawn > given:
        raise UserError(
            f"recipe.nets_per_step={drawn}: there are {given} other_nets. Give more, or null."
        )
    tasks: list[Task] = []
    for name in cfg.other_nets or () if cfg.learn == "sampler" else ():
        from mops_lightning.zoo.load import read_net  # imports every net

        try:
            if accepted(cfg.task, {"num_parts": 0}):
                raise UserError("no file can name a net of segmentation. Leave other_nets out.")
            net, classes = read_net(name)
            known = accepted(cfg.task, {"num_classes": len(dataset.class_names)})
            tasks.append(build_as(Task, cfg.task, "task", net=net, **known))
            check_names(classes, tasks[-1], dataset, name)
        except UserError as error:
            raise UserError(f"other_nets: {error}") from None
    return tasks
