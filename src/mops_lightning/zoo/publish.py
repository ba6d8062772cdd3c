"""From a run to a model: the card is written from the run's record."""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, get_args

from safetensors.torch import load_file

from mops_lightning.errors import UserError
from mops_lightning.records import run_record
from mops_lightning.records.metric_info import metric_info
from mops_lightning.records.readout_names import FULL, ROWS, MetricName, parse_metric_name
from mops_lightning.records.run_record import RunRecord
from mops_lightning.zoo import model_file, names, weights
from mops_lightning.zoo.model_file import Precision
from mops_lightning.zoo.rounding import is_wide, rounded

BITS = {"float16": 16, "bfloat16": 16, "int8": 8}
ROUNDED = "The test figures are those before wide layers were rounded to {} bits."
"""Note of a model with rounded weights, since its figures are those of the run."""
MEASURED = "Wide layers are in {} bits; the record's figures are those before."
"""Note of a model with rounded weights and figures of its own."""


def add(
    run: Path,
    name: str,
    folder: Path,
    *,
    task_net: str | None = None,
    precision: Precision = "float32",
    licence: str = "MIT",
    notes: str = "",
    overwrite: bool = False,
) -> Path:
    """Write the net that a run trained as a model.

    Args:
        run: folder of a completed run with weights.
        name: the model's name, such as ``fmops.chairs-m64``.
        folder: where ``NAME.safetensors`` is written.
        task_net: the model of a sampler's task net; None looks for the one that was used, in
            ``folder`` first.
        precision: of weight matrices with at least ``rounding.WIDE`` entries. The card's figures
            are those before rounding, and its notes say so.
        licence: of the model.
        notes: what a user must know besides.
        overwrite: replace a model of this name.

    Returns:
        The file.

    Raises:
        UserError: the name is not allowed or taken, the precision is none of these, or the run has
            no weights.
    """
    if precision not in get_args(Precision):
        allowed = ", ".join(get_args(Precision))
        raise UserError(f"precision must be one of {allowed}, got {precision!r}.")
    path = _free_path(folder, name, overwrite)
    record = _whole_record(run)
    content = weights.read(weights.of_run(run))
    state = content["state"]
    if not any(is_wide(value) for value in state.values()):
        precision = "float32"
    if precision != "float32":
        state = rounded(state, precision)
        notes = f"{notes} {ROUNDED.format(BITS[precision])}".lstrip()
    files = {"weights": name}
    if record.config["learn"] == "sampler":
        used = _task_net(task_net, record, folder)
        if used is not None:
            files["task_weights"] = used
    card: dict[str, Any] = {
        "schema": model_file.MODEL,
        "name": name,
        "transform": "unit_sphere",
        "licence": licence,
        "precision": precision,
        "notes": notes,
        "classes": content["classes"],
        "figures": card_figures(record),
        "record": {**record.plain(), "files": files},
    }
    if content["channels"]:
        card["channels"] = content["channels"].to_plain()
    model_file.write(path, card, state)
    return path


def measure(model: str | Path, evaluation: Path) -> None:
    """Replace the test figures of a model by its own, because rounding moves those of its run.

    Args:
        model: a file or what ``names.resolve`` takes; its file is written again.
        evaluation: folder of a run of ``evaluate=`` with this model.

    Raises:
        UserError: another model or other test data were evaluated, the test was shortened or did
            not complete, or the model is damaged.
    """
    path = names.resolve(model)
    weights.read(path)  # verifies the tensors, before they get a new header
    card = model_file.read_card(path)
    record = run_record.read(evaluation)
    if record.status != "completed" or record.partial:
        raise UserError(f"{evaluation} is not a whole test. Repeat it without what shortened it.")
    evaluated = record.evaluated
    if evaluated is None or evaluated.weights_sha256 != card["sha256"]:
        raise UserError(
            f"{evaluation} did not test {path}. Give the folder of a run of evaluate={path}."
        )
    trained = run_record.from_plain(card["record"])
    if _tested_on(record) != _tested_on(trained):
        raise UserError(
            f"{evaluation} tested {path} on other data than the run that trained it. Repeat it "
            "with the data, noise and corruption of that run."
        )
    bits = BITS.get(card["precision"])
    if bits is not None:
        card["notes"] = card["notes"].replace(ROUNDED.format(bits), MEASURED.format(bits))
    card["figures"] = card_figures(record)
    del card["sha256"]
    model_file.write(path, card, load_file(path))


def _tested_on(record: RunRecord) -> tuple[Any, ...]:
    """Return what the test figures of a record depend on, besides the nets."""
    config = record.config
    dataset = config.get("names", {}).get("dataset")
    disturbed = (config.get("test_noise_std"), config.get("test_corruption"))
    return (dataset, record.test_clouds, *disturbed)


def _free_path(folder: Path, name: str, overwrite: bool) -> Path:
    """Return the file of a new model.

    Raises:
        UserError: the name is not allowed or taken.
    """
    if not names.is_name(name):
        raise UserError(
            f"NAME must be words of a-z, 0-9, _ and - with dots between, such as "
            f"fmops.chairs-m64, got {name!r}."
        )
    path = folder / f"{name}{model_file.SUFFIX}"
    if path.exists() and not overwrite:
        raise UserError(f"{path} exists. Give another NAME, or --overwrite.")
    return path


def _whole_record(run: Path) -> RunRecord:
    """Return the record of a completed run with weights that nothing shortened.

    Raises:
        UserError: the run is another one.
    """
    record = run_record.read(run)
    if not _has_weights(record):
        raise UserError(f"{run}: not a completed run that kept its weights. Give another RUN.")
    if record.partial:
        raise UserError(
            f"{run}: {' and '.join(record.partial)}. A model is made from a whole run. Repeat "
            "it without what shortened it."
        )
    return record


def _has_weights(record: RunRecord) -> bool:
    return record.status == "completed" and "weights" in record.files


def add_all(runs: Iterable[Path], sweep: Path, folder: Path) -> list[Path]:
    """Write the nets that runs of a sweep trained as models, named ``SWEEP.RUN`` after its folders.

    Task nets come first, so that the cards of samplers name them. Models of these names are
    replaced. Runs that are not completed or kept no weights are left out.

    Args:
        runs: folders of runs.
        sweep: folder that contains them.
        folder: where the files are written.

    Returns:
        The files, in the order in which they were written.
    """
    task_nets: list[tuple[str, Path]] = []
    samplers: list[tuple[str, Path]] = []
    for run in runs:
        record = run_record.read(run)
        if not _has_weights(record):
            continue
        parts = (sweep.name, str(run.relative_to(sweep)))
        name = ".".join(re.sub(r"[^a-z0-9_-]+", "-", part.lower()) for part in parts)
        if record.config["learn"] == "task":
            task_nets.append((name, run))
        else:
            samplers.append((name, run))
    in_order = [*sorted(task_nets), *sorted(samplers)]
    return [add(run, name, folder, overwrite=True) for name, run in in_order]


def card_figures(record: RunRecord) -> dict[str, Any]:
    """Return a record's score by readout, at the run's own size, for a card."""
    scores: dict[MetricName, float] = {}
    for key, value in record.metrics.items():
        parsed = parse_metric_name(key)
        if value is not None and parsed is not None:
            scores[parsed] = value
    score = parse_metric_name(record.score_name)
    if score is None or score not in scores:
        raise UserError("the record of the run has no test score. Give a run that was tested.")
    info = metric_info(score.metric, [record])
    is_full = score.readout == FULL
    values = {}
    for name, value in scores.items():
        is_of_score = (name.m, name.metric) == (score.m, score.metric)
        is_shown = is_of_score and name.readout in ROWS and (name.readout == FULL) == is_full
        if is_shown:
            values[name.readout] = info.format(value)
    return {
        "metric": info.title,
        "m": None if is_full else score.m or record.config["m"],
        "points": record.config["dataset"].get("n_points"),
        "values": values,
    }


def _task_net(name: str | None, record: RunRecord, folder: Path) -> str | None:
    """Return a reference to the model of a sampler's task net, or None if it is not a model."""
    if name is not None:
        path = names.find_model(name)
        if path is None:
            raise UserError(f"--task-net: no model {name!r}. `mops-lightning models` lists all.")
        card = model_file.read_card(path)
        if card["record"]["config"]["learn"] != "task":
            raise UserError(f"--task-net: {name} is a sampler. Give the model of a task net.")
        return names.pinned(name, card["sha256"])
    used = {record.weights_loaded, record.task_weights_sha256}
    for model, path in {**names.available(), **names.in_folder(folder)}.items():
        try:
            sha256 = model_file.read_card(path)["sha256"]
        except UserError:  # a damaged or foreign file is not the one that was used
            continue
        if sha256 in used:
            return names.pinned(model, sha256)
    return None
