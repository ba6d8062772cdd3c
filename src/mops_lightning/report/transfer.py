"""A table of the same samples under several task nets: size × sampler × net."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from mops_lightning.metrics.info import MetricInfo
from mops_lightning.records.metric_info import metric_info
from mops_lightning.records.readout_names import FULL, parse_transfer, size_prefix
from mops_lightning.records.run_record import RunRecord
from mops_lightning.report.axes import Axes
from mops_lightning.report.cells import Cells, Column, make_cells, over_seeds
from mops_lightning.report.comparable import require_one
from mops_lightning.report.text import Grid


def transfer_grid(
    found: list[RunRecord], own: Cells, names: Mapping[str, str], axes: Axes
) -> Grid | None:
    """Return the scores of the same samples under the nets of ``task_nets``.

    Args:
        found: the completed records of the table.
        own: their values under the task net of the training.
        names: what the records share; see ``comparable.shared_names``.
        axes: the meaning of the columns of ``own``, which are rows here.

    Returns:
        A row for each sampler at each size, or at each value of another setting, and a row for all
        points. None for heat maps, and if no record has such scores of the metric.

    Raises:
        UserError: two nets have the same label.
    """
    metric = own.metric
    nets = {label: [_under(record, label) for record in found] for label in _labels(found)}
    nets = {
        label: records
        for label, records in nets.items()
        if any(name.endswith(f"/{metric.name}") for one in records for name in one.metrics)
    }
    if axes.planes or not nets:
        return None
    heads = [f"{names['net']} of the training", *nets]
    tables = [make_cells(records, metric.name, names["net"], axes) for records in nets.values()]
    rows = []
    for place in own.columns():
        for name in own.rows():
            texts = [_text(table, name, place) for table in (own, *tables)]
            if any(texts[1:]):
                rows.append([f"{place}", name, *texts])
    # Errors that are normalized by those of full clouds are 1 there.
    full = metric_info(metric.full_cloud_metric or metric.name, found)
    label = f"all points ({full.title})" if metric.full_cloud_metric else "all points"
    rows.append(["", label, *(_full(records, full) for records in (found, *nets.values()))])
    title = (
        f"Test {metric.title} of the same samples under task nets that had no part in the "
        f"training: {names['task']} on {names['dataset']}; generated / matched / completed sets, "
        "or one figure for samplers that choose input points."
    )
    return Grid(
        title, [axes.column, "sampled by", *heads], rows, [_fact(found, one) for one in nets]
    )


def _labels(found: list[RunRecord]) -> list[str]:
    """Return the labels of all nets, sorted, each of which must mean one net."""
    labels = sorted({label for record in found for label in _notes(record)})
    for label in labels:
        hashes = {_notes(record).get(label, {}).get("sha256") for record in found}
        require_one(f"the weights of {label} (sha256)", hashes - {None})
    return labels


def _notes(record: RunRecord) -> dict[str, Any]:
    return record.task_nets


def _under(record: RunRecord, label: str) -> RunRecord:
    """Return a record whose test metrics are those under one of the further nets."""
    metrics = {}
    for name, figure in record.metrics.items():
        found = parse_transfer(name)
        if found and found[0] == label:
            parts = found[1]
            metrics[f"test/{size_prefix(parts.m)}{parts.readout}/{parts.metric}"] = figure
    return replace(record, metrics=metrics)


def _text(table: Cells, row: str, column: Column) -> str:
    return table.text(row, column) if row in table.values else ""


def _full(records: list[RunRecord], metric: MetricInfo) -> str:
    """Return the value on full clouds; over the distinct ones where data depend on the seed."""
    values = [one.metrics.get(f"test/{FULL}/{metric.name}") for one in records]
    distinct = sorted({value for value in values if value is not None})
    return over_seeds(metric, distinct) if distinct else ""


def _fact(found: list[RunRecord], label: str) -> str:
    """Return a line about a net: how long it was trained, on what, and which weights it has."""
    note = next(_notes(record)[label] for record in found if label in _notes(record))
    return (
        f"{label}: {note.get('max_epochs')} epochs on {note.get('dataset')}, sha256 "
        f"{str(note.get('sha256'))[:12]}."
    )
