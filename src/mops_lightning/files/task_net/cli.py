"""``compare --task-net RUN``: methods of downsampling by the loss and the score of a task net."""

import argparse

from mops_lightning.errors import UserError
from mops_lightning.files.arguments import Add, columns_of

ONLY_TASK_NET = ("task_net", "loss", "label", "save")
"""Options of this comparison alone."""


def add_arguments(add: Add) -> None:
    """Declare the options that ``--task-net`` alone has."""
    add(
        "--task-net",
        metavar="RUN",
        help="score a trained task net: a run, a model or a weights file; or with --loss a net of "
        "your own, my_module.my_net, a torch.nn.Module or a function that returns one",
    )
    add(
        "--loss",
        metavar="NAME",
        help="--task-net: loss of a net of your own, a function my_module.my_loss(output, batch)",
    )
    add(
        "--label",
        metavar="COLUMN",
        help="--task-net: column with the parts of points, for segmentation; default: as in "
        "training",
    )
    add(
        "--save",
        metavar="NAME",
        help="--task-net: keep the best method of every number of points, chosen on one half of "
        "the files and checked on the other, as a sampler: NAME.safetensors",
    )


def compare_by_net(chosen: argparse.Namespace) -> None:
    """Compare methods by a task net, write the files and print the table.

    Raises:
        UserError: an argument or a file is invalid.
    """
    if chosen.tile is not None:
        raise UserError("--tile is not for --task-net, which draws crops of the net's size.")
    from mops_lightning.files.task_net.compare import DRAWS, compare_task_net
    from mops_lightning.files.task_net.subject import imported, imported_module
    from mops_lightning.files.task_net.tables import FILES

    loss = None
    net = chosen.task_net
    if chosen.loss is not None:
        net = imported_module(chosen.task_net)
        loss = imported(chosen.loss, "--loss")
    draws = chosen.draws
    if draws is None:
        draws = DRAWS
    comparison = compare_task_net(
        chosen.files,
        net,
        chosen.m,
        loss=loss,
        weights=chosen.weights or (),
        methods=chosen.methods,
        draws=draws,
        crops=chosen.crops,
        points=chosen.points,
        label=chosen.label,
        columns=columns_of(chosen),
        seed=chosen.seed,
        save=chosen.save,
        out=chosen.out,
        overwrite=chosen.overwrite,
    )
    files = ", ".join(FILES)
    print(f"files in {chosen.out}/: {files}")
    print(comparison.text, end="")
