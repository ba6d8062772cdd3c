"""The subcommands ``models`` and ``export``."""

import argparse
import os
from pathlib import Path
from typing import Any

from mops_lightning.errors import Parser, UserError, one_line_endings, printable
from mops_lightning.zoo import model_file, names

DESCRIPTION = f"""List trained models, show the card of one, or publish a run as one.

  models                list all models: of this package and of ${names.VARIABLE}
  models NAME           show a card
  models add RUN NAME   write the net that RUN trained to a folder, as NAME.safetensors

A name can be given wherever a weights file or a run can: weights=NAME, evaluate=NAME,
downsample --weights NAME, export NAME. ${names.VARIABLE} is a list of folders, as in PATH."""

EXPORT = """Write a trained sampler as ONNX (.onnx) or as a PyTorch program (.pt2).

The file maps points (batch, points, 3), float32 in the unit sphere, to generated points
(batch, m, 3), for any number of clouds and points, and runs without mops_lightning. It is compared
with the sampler before it is written."""


def main(arguments: list[str], prog: str) -> None:
    """Do what the arguments say.

    Args:
        arguments: of the command line.
        prog: what the user typed to start this command.
    """
    parser = Parser(prog, DESCRIPTION)
    add = parser.add_argument
    add("words", nargs="*", metavar="NAME | add RUN NAME", help="see above")
    new = parser.add_argument_group("options of add")
    new.add_argument("--folder", type=Path, help=f"where to; default: first of ${names.VARIABLE}")
    new.add_argument("--task-net", metavar="NAME", help="model of the sampler's task net")
    new.add_argument("--notes", default="", help="what a user must know besides")
    new.add_argument("--overwrite", action="store_true", help="replace a model of this name")
    with one_line_endings(prog):
        chosen = parser.parse_args(arguments)
        _refuse_unused(chosen, parser)
        print(printable("\n".join(_run(chosen))))


def _refuse_unused(chosen: argparse.Namespace, parser: Parser) -> None:
    """Refuse options of `models add` without it.

    Raises:
        UserError: an option is not used.
    """
    values = {name: value for name, value in vars(chosen).items() if name != "words"}
    given = {name for name, value in values.items() if value != parser.get_default(name)}
    if given and chosen.words[:1] != ["add"]:
        option = min(given).replace("_", "-")
        raise UserError(f"--{option} is an option of `models add RUN NAME`. Leave it out.")


def _run(chosen: argparse.Namespace) -> list[str]:
    """Return the lines to print."""
    match chosen.words:
        case []:
            return _table()
        case ["add", run, name]:
            return _add(chosen, Path(run).expanduser(), name)
        case ["add", *_]:
            raise UserError("add takes a run and a name: models add RUN NAME.")
        case [name]:
            path = names.resolve(name)
            card = model_file.read_card(path)
            return _card(card, path)
    raise UserError(f"give one NAME, or add RUN NAME, got {' '.join(chosen.words)}.")


def _add(chosen: argparse.Namespace, run: Path, name: str) -> list[str]:
    from mops_lightning.zoo import publish

    own = os.environ.get(names.VARIABLE)
    folder = chosen.folder or (names.folders()[0] if own else None)
    if folder is None:
        raise UserError(
            f"give --folder FOLDER, or set ${names.VARIABLE} to the folder of your models."
        )
    path = publish.add(
        run,
        name,
        folder,
        task_net=chosen.task_net,
        notes=chosen.notes,
        overwrite=chosen.overwrite,
    )
    card = model_file.read_card(path)
    record = card["record"]
    lines = [
        f"{path}: {_megabytes(path)} MB",
        f"Records name it {names.pinned(name, card['sha256'])}.",
    ]
    if record["config"]["learn"] != "task" and "task_weights" not in record["files"]:
        lines.append(f"Its task net is not a model: evaluate={name} also needs weights=FILE.")
    found = names.available().get(name)
    if found is None or not found.samefile(path):
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
        rows.append(
            (
                name,
                card["record"]["config"]["names"]["task"],
                _sizes(card),
                _figures(card),
                card["licence"].partition(";")[0],
                _megabytes(path),
            )
        )
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
    return lines + unreadable


def _card(card: dict[str, Any], path: Path) -> list[str]:
    record = card["record"]
    config, commit = record["config"], record["git"]["commit"]
    chosen = config["names"]
    alone = config["learn"] == "task"
    classes = config["dataset"].get("classes")
    data = chosen["dataset"] + (f" ({', '.join(map(str, classes))})" if classes else "")
    points = config["dataset"].get("n_points")
    wide = f", wide layers in {card['precision']}" if card["precision"] != "float32" else ""
    lines = {
        "name": card["name"],
        "net": f"{chosen['net']} (task net)" if alone else f"{chosen['sampler']} (sampler)",
        "task": f"{chosen['task']} by {chosen['net']}",
        "sizes": _sizes(card),
        "input": "clouds in the unit sphere (centroid at the origin, largest distance from it 1)",
        "test figures": _figures(card),
        "data": data + (f", {points} points per cloud in training" if points else ""),
        "recipe": " ".join(record["overrides"]) or "the defaults",
        "epochs": str(config["trainer"]["max_epochs"]),
        "seed": str(record["seed"]),
        "commit": (commit or "unknown") + (" (changed)" if record["git"]["dirty"] else ""),
        "task net": record["files"].get("task_weights", "").partition(names.PIN)[0],
        "classes": ", ".join(card["classes"]),
        "licence": card["licence"],
        "notes": card["notes"],
        "file": f"{path}, {_megabytes(path)} MB{wide}",
        "sha256": f"{card['sha256']} (of the tensors)",
    }
    width = max(map(len, lines)) + 2
    return [f"{key:<{width}}{' '.join(value.split())}" for key, value in lines.items() if value]


def _sizes(card: dict[str, Any]) -> str:
    config = card["record"]["config"]
    if config["learn"] == "task":
        return ""
    largest = config["sampler"].get("m_max")
    return f"1-{largest}" if largest else str(config["m"])


def _figures(card: dict[str, Any]) -> str:
    own = card["figures"]
    values = own["values"]
    if own["m"] is None:
        return f"{own['metric']}: {values.get('full', 'unknown')} on all points"
    listed = ", ".join(f"{value} {readout}" for readout, value in values.items())
    return f"{own['metric']}, m={own['m']}: {listed}"


def _megabytes(path: Path) -> str:
    return f"{path.stat().st_size / 1e6:.2f}"


def export(arguments: list[str], prog: str) -> None:
    """Write the file and print how far its points are from the sampler's.

    Args:
        arguments: of the command line.
        prog: what the user typed to start this command.
    """
    parser = Parser(prog, EXPORT)
    add = parser.add_argument
    add("sampler", metavar="SAMPLER", help="a model's name, a run or a weights file")
    add("target", metavar="OUT", type=Path, help="a file that ends in .onnx or .pt2")
    add("--m", type=int, help="number of points; default: as the sampler was trained for")
    add("--overwrite", action="store_true", help="replace an existing file")
    with one_line_endings(prog):
        chosen = parser.parse_args(arguments)
        if chosen.target.exists() and not chosen.overwrite:
            raise UserError(f"{chosen.target} exists. Give another OUT, or --overwrite.")
        from mops_lightning.zoo import export as files
        from mops_lightning.zoo.load import load

        difference = files.export(load(chosen.sampler), chosen.target, chosen.m)
        size = chosen.target.stat().st_size / 1e6
        print(
            f"{chosen.target}: {size:.2f} MB; largest difference from the sampler {difference:.1e}"
        )
