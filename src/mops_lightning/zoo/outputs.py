"""The classes or parts that a net of a file tells apart."""

from mops_lightning.data.clouds import CloudDataset
from mops_lightning.errors import UserError
from mops_lightning.tasks.base import Task


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
    kind = "parts"
    if task.output_names == "class_names":
        kind = "classes"
    if names is None:
        raise UserError(
            f"{what} does not name the {kind} of its net, so it can be used with its own data only."
        )
    if list(names) != own:
        missing = [name for name in names if name not in own] or list(names)
        of_net = ", ".join(missing[:3])
        of_data = ", ".join(own[:3])
        raise UserError(
            f"{what}: its net has {len(names)} {kind}, which are not the {len(own)} {kind} "
            f"of the data: {of_net} ... instead of {of_data} .... "
            f"Give a task net of these {kind} with weights=auto, or data of its {kind} with "
            "dataset.classes or dataset.label."
        )
