"""The subcommands ``models`` and ``export``."""

import os
from pathlib import Path
from typing import Any

from mops_lightning.errors import Parser, UserError, one_line_endings, printable
from mops_lightning.zoo import model_file, names

DESCRIPTION = f"""List trained models, show the card of one, or publish a run as one.

  models                list all models: of this package and of ${names.VARIABLE}
  models NAME           show a card
  models add RUN NAME   write the net that RUN trained to a folder, as NAME.safetensors:
                        see models add --help

A name can be given wherever a weights file or a run can: weights=NAME, evaluate=NAME,
downsample --weights NAME, export NAME. ${names.VARIABLE} is a list of folders, as in PATH."""

EXPORT = """Write a trained sampler as ONNX (.onnx) or as a PyTorch program (.pt2).

The file maps points (batch, points, 3), float32 in the unit sphere, to generated points
(batch, m, 3), for any number of clouds and points, and runs without mops_lightning. It is compared
with the sampler before it is written."""


def main(arguments: list[str], prog: str) -> None:
    """Do what the arguments say.

    Args:
        arguments: the arguments behind the subcommand.
        prog: what the user typed to start this command.
    """
    with one_line_endings(prog):
        if arguments[:1] == ["add"]:
            lines = _add(arguments[1:], f"{prog} add")
        else:
            parser = Parser(prog, DESCRIPTION)
            parser.add_argument("name", nargs="?", metavar="NAME", help="see above")
            options = parser.parse_args(arguments)
            if options.name is None:
                lines = _table()
            else:
                lines = _card(names.resolve(options.name))
        print(printable("\n".join(lines)))


def _add(arguments: list[str], prog: str) -> list[str]:
    """Write the net of a run as a model, and return the lines to print."""
    parser = Parser(prog, "Write the net that RUN trained to a folder, as NAME.safetensors.")
    add = parser.add_argument
    add("run", type=Path, metavar="RUN", help="folder of a run")
    add("name", metavar="NAME", help="such as fmops.chairs-m64")
    add("--folder", type=Path, help=f"where to; default: first of ${names.VARIABLE}")
    add("--task-net", metavar="NAME", help="model of the sampler's task net")
    add("--notes", default="", help="what a user must know besides")
    add("--overwrite", action="store_true", help="replace a model of this name")
    options = parser.parse_args(arguments)
    from mops_lightning.zoo import publish

    name = options.name
    folder = options.folder
    if folder is None:
        if not os.environ.get(names.VARIABLE):
            raise UserError(
                f"give --folder FOLDER, or set ${names.VARIABLE} to a folder of models."
            )
        folder = names.folders()[0]
    path = publish.add(
        options.run,
        name,
        folder,
        task_net=options.task_net,
        notes=options.notes,
        overwrite=options.overwrite,
    )
    card = model_file.read_card(path)
    record = card["record"]
    lines = [
        f"{path}: {_megabytes(path)} MB",
        f"Records name it {names.pinned(name, card['sha256'])}.",
    ]
    if record["config"]["learn"] != "task" and "task_weights" not in record["files"]:
        lines.append(f"Its task net is not a model: evaluate={name} also needs weights=FILE.")
    present = names.available().get(name)
    if present is None or not present.samefile(path):
        lines.append(f"To find it by name, set {names.VARIABLE}={folder}.")
    return lines


def _table() -> list[str]:
    rows = [("name", "task", "sizes", "test figures", "licence", "MB")]
    unreadable = []
    for name, path in names.available().items():
        try:
            card = model_file.read_card(path)
        except UserError as error:
            unreadable.append(f"Not listed: {error}")
            continue
        task = card["record"]["config"]["names"]["task"]
        licence = card["licence"].partition(";")[0]
        row = (name, task, _sizes(card), _figures(card), licence, _megabytes(path))
        rows.append(row)
    columns = zip(*rows, strict=True)
    widths = [max(len(cell) for cell in column) for column in columns]
    lines = []
    for row in rows:
        cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]
        lines.append("  ".join(cells).rstrip())
    return lines + unreadable


def _card(path: Path) -> list[str]:
    card = model_file.read_card(path)
    record = card["record"]
    config = record["config"]
    choices = config["names"]
    if config["learn"] == "task":
        net = f"{choices['net']} (task net)"
    else:
        net = f"{choices['sampler']} (sampler)"
    lines = {
        "name": card["name"],
        "net": net,
        "task": f"{choices['task']} by {choices['net']}",
        "sizes": _sizes(card),
        "input": "clouds in the unit sphere (centroid at the origin, largest distance from it 1)",
        "channels": ", ".join(name for name, _, _ in card.get("channels", [])),
        "test figures": _figures(card),
        "data": _data(config),
        "recipe": " ".join(record["overrides"]) or "the defaults",
        "epochs": str(config["trainer"]["max_epochs"]),
        "seed": str(record["seed"]),
        "commit": _commit(record),
        "task net": record["files"].get("task_weights", "").partition(names.PIN)[0],
        "classes": ", ".join(card["classes"]),
        "licence": card["licence"],
        "notes": card["notes"],
        "file": _file(path, card),
        "sha256": f"{card['sha256']} (of the tensors)",
    }
    width = max(len(key) for key in lines) + 2
    shown = []
    for key, value in lines.items():
        if value:
            shown.append(key.ljust(width) + " ".join(value.split()))
    return shown


def _data(config: dict[str, Any]) -> str:
    """Return the name of the data of a training, with the classes and points that it chose."""
    text = str(config["names"]["dataset"])
    classes = config["dataset"].get("classes")
    points = config["dataset"].get("n_points")
    if classes:
        text += f" ({', '.join(map(str, classes))})"
    if points:
        text += f", {points} points per cloud in training"
    return text


def _commit(record: dict[str, Any]) -> str:
    text = str(record["git"]["commit"] or "unknown")
    if record["git"]["dirty"]:
        text += " (changed)"
    return text


def _file(path: Path, card: dict[str, Any]) -> str:
    text = f"{path}, {_megabytes(path)} MB"
    if card["precision"] != "float32":
        text += f", wide layers in {card['precision']}"
    return text


def _sizes(card: dict[str, Any]) -> str:
    config = card["record"]["config"]
    if config["learn"] == "task":
        return ""
    largest = config["sampler"].get("m_max")
    if largest:
        return f"1-{largest}"
    return str(config["m"])


def _figures(card: dict[str, Any]) -> str:
    figures = card["figures"]
    values = figures["values"]
    if figures["m"] is None:
        return f"{figures['metric']}: {values.get('full', 'unknown')} on all points"
    texts = [f"{value} {readout}" for readout, value in values.items()]
    listed = ", ".join(texts)
    return f"{figures['metric']}, m={figures['m']}: {listed}"


def _megabytes(path: Path) -> str:
    return f"{path.stat().st_size / 1e6:.2f}"


def export(arguments: list[str], prog: str) -> None:
    """Write the file and print how far its points are from the sampler's.

    Args:
        arguments: the arguments behind the subcommand.
        prog: what the user typed to start this command.
    """
    parser = Parser(prog, EXPORT)
    add = parser.add_argument
    add("sampler", metavar="SAMPLER", help="a model's name, a run or a weights file")
    add("target", metavar="OUT", type=Path, help="a file that ends in .onnx or .pt2")
    add("--m", type=int, help="number of points; default: as the sampler was trained for")
    add("--overwrite", action="store_true", help="replace an existing file")
    with one_line_endings(prog):
        options = parser.parse_args(arguments)
        target = options.target
        if target.exists() and not options.overwrite:
            raise UserError(f"{target} exists. Give another OUT, or --overwrite.")
        from mops_lightning.zoo import export as files
        from mops_lightning.zoo.load import load

        difference = files.export(load(options.sampler), target, options.m)
        print(
            f"{target}: {_megabytes(target)} MB; "
            f"largest difference from the sampler {difference:.1e}"
        )
