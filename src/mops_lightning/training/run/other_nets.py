"""Task nets from files: further ones that a sampler is trained under, and their classes."""

from omegaconf import DictConfig

from mops_lightning.config.build import accepted, build_as
from mops_lightning.data.clouds import CloudDataset
from mops_lightning.errors import UserError
from mops_lightning.tasks.base import Task


def other_tasks(cfg: DictConfig, dataset: CloudDataset) -> list[Task]:
    """Build the run's task with each net of ``other_nets``.

    Raises:
        UserError: a file holds no task net, or one of another task or of other classes.
    """
    tasks: list[Task] = []
    for name in cfg.other_nets or () if cfg.learn == "sampler" else ():
        from mops_lightning.zoo.load import read_net  # imports every net

        try:
            if accepted(cfg.task, {"num_parts": 0}):
                raise UserError("no file can name a net of segmentation. Leave other_nets out.")
            net, classes = read_net(name)
            known = accepted(cfg.task, {"num_classes": len(dataset.class_names)})
            tasks.append(build_as(Task, cfg.task, "task", net=net, **known))
            if tasks[-1].requires_same_classes:
                check_classes(classes, dataset, name)
        except UserError as error:
            raise UserError(f"other_nets: {error}") from None
    return tasks


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
