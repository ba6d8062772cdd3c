"""From the records of a folder to its report: tables, their texts, and remarks."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from mops_lightning.records.run_record import RunRecord
from mops_lightning.report import collect
from mops_lightning.report.comparable import Group, groups, net_groups, weightless
from mops_lightning.report.grids import grids
from mops_lightning.report.nets import nets_grid
from mops_lightning.report.provenance import collapses, edited, provenance, without_result
from mops_lightning.report.tables import Table, make_table
from mops_lightning.report.text import Grid

NOT_COMPARABLE = "{} groups of runs are not comparable and have tables of their own."

MIXED_JOINS = " --mixed joins groups that differ in commit or settings only."


@dataclass(frozen=True)
class Report:
    """The content of a folder's report.

    Attributes:
        found: the runs.
        tables: one for each group of comparable runs and metric; none for task nets alone.
        grids: the texts of all tables.
        remarks: how the runs were made, and which have no result.
    """

    found: collect.Found
    tables: list[Table]
    grids: list[Grid]
    remarks: list[str]


def build_report(folder: Path, metrics: Iterable[str] = (), mixed: bool = False) -> Report:
    """Make the tables of all completed records below ``folder``, one for each group and metric.

    Args:
        folder: the records' folder.
        metrics: names of the metrics to show; none: the main metric of the records' task.
        mixed: whether runs of different commits and settings may be in one table.

    Raises:
        UserError: there is no record, or no record has a metric.
    """
    found = collect.collect(folder)
    wanted = list(metrics)
    of_samplers = [record for record in found.done if record.config["learn"] != "task"]
    tables: list[Table] = []
    shown, split = found.done, net_groups
    if of_samplers:
        shown, split = of_samplers, groups
    parts = split(shown, mixed)
    if of_samplers:
        tables = _tables(parts, wanted, collect.tested_metrics(of_samplers))
        texts = [grid for table in tables for grid in grids(table)]
    else:
        texts = [nets_grid(part, wanted) for part in parts]
    remarks = _about_runs(found, shown, tables)
    remarks += edited(found.done)
    if len(parts) > 1:
        apart = NOT_COMPARABLE.format(len(parts))
        if len(split(shown, mixed=True)) < len(parts):
            apart += MIXED_JOINS
        remarks += ["", apart]
    remarks += without_result(found)
    return Report(found, tables, texts, remarks)


def _tables(parts: list[Group], wanted: list[str], known: set[str]) -> list[Table]:
    """Return a table for each group and metric.

    Args:
        parts: the groups.
        wanted: the metrics; none: the main metric of each group.
        known: all metrics that a sampled set was tested by.
    """
    tables = []
    for part in parts:
        tested = collect.tested_metrics(part.records)
        metrics = wanted or [collect.score(part.records)]
        for metric in metrics:
            # A metric of one task only has tables for it; make_table refuses an unknown one.
            is_of_other_task = metric in known and metric not in tested
            if not is_of_other_task:
                tables.append(make_table(part, metric, _net(part)))
    return tables


def _net(group: Group) -> str:
    """Return the task net of a group's table; empty for a table by net."""
    if group.column == "net":
        return ""
    trained = [record for record in group.records if not weightless(record)]
    records = trained or group.records
    return collect.names(records[0])["net"]


def _about_runs(found: collect.Found, shown: list[RunRecord], tables: list[Table]) -> list[str]:
    """Return how the runs of the tables' tasks were made, and which are hidden by a later one."""
    tasks = {collect.names(record)["task"] for record in shown}
    of_tasks = [record for record in found.done if collect.names(record)["task"] in tasks]
    nets = {table.net for table in tables}
    net = ""
    if len(nets) == 1:
        net = nets.pop()
    hidden: set[str] = set()
    for table in tables:
        hidden.update(table.hidden)
    lines = provenance(of_tasks, net)
    lines += collapses(of_tasks, net)
    for run in sorted(hidden):
        lines.append(f"- {run}: not shown; a later run has the same row, column and seed")
    return lines
