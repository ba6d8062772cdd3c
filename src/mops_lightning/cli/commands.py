"""The subcommands of the program."""

from typing import NamedTuple


class Command(NamedTuple):
    """A subcommand.

    Attributes:
        module: has ``main(arguments, prog)``; imported when it is used.
        summary: its line in ``--help``.
    """

    module: str
    summary: str


COMMANDS = {
    "report": Command(
        "mops_lightning.report.cli", "tables, plots and a page from the records of runs"
    ),
    "downsample": Command(
        "mops_lightning.files.downsample_cli", "downsample clouds and meshes from files"
    ),
    "compare": Command(
        "mops_lightning.files.compare_cli", "compare downsampling methods on your own files"
    ),
    "models": Command(
        "mops_lightning.cli.models", "trained models: list, show a card, publish a run as one"
    ),
    "export": Command("mops_lightning.cli.export", "write a trained sampler as .onnx or .pt2"),
}


def help_lines() -> str:
    """Return one line of help for each subcommand."""
    width = max(map(len, COMMANDS)) + 2
    return "\n".join(f"{name:<{width}}{command.summary}" for name, command in COMMANDS.items())
