"""Task nets from files: further ones that a sampler is trained under, and their classes."""

from omegaconf import DictConfig

from mops_lightning.config.build import accepted, build_as
from mops_lightning.data.clouds import CloudDataset
from mops_lightning.errors import UserError
from mops_lightning.tasks.base import Task


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


def check_names(names: list[str] | None, task: Task, dataset: CloudDataset, what: str) -> None:
    """Reject a net whose outputs are other classes or parts than the data's.

    Args:
        names: the classes or parts that the net was trained on; None if unknown.
        task: of the net.
        dataset: the data.
        what: the file or folder of the net.

    Raises:
        UserError: they differ, or are unknown.
    """
    if task.output_names is None:
        return
    own = list(getattr(dataset, task.output_names))
    kind = "classes" if task.output_names == "class_names" else "parts"
    if names is None:
        raise UserError(
            f"{what} does not name the {kind} of its net, so it can be used with its own data only."
        )
    if list(names) != own:
        missing = [name for name in names if name not in own] or list(names)
        raise UserError(
            f"{what}: its net has {len(names)} {kind}, which are not the {len(own)} {kind} "
            f"of the data: {', '.join(missing[:3])} ... instead of {', '.join(own[:3])} .... "
            f"Give a task net of these {kind} with weights=auto, or data of its {kind} with "
            "dataset.classes or dataset.label."
        )
