"""Which runs one table may show: groups of comparable records, and the layout of their tables."""

import json
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import pandas as pd

from mops_lightning.config.settings import of as declaration
from mops_lightning.config.shared_settings import table_settings, with_defaults
from mops_lightning.records.run_record import RunRecord
from mops_lightning.records.summary import OF_TEST_CLOUDS
from mops_lightning.report import collect
from mops_lightning.report.collect import (
    epochs,
    recorded_recipe,
    sampler_row,
    seed,
    text_to_compare,
    trained_with,
)
from mops_lightning.tree import dotted

Row = tuple[str, str]
"""A row of a table: its sampler and its task net."""

Key = Callable[[RunRecord], tuple[str, ...] | None]
"""What a record is sorted by; None for a record that belongs to every group."""

IN_ROWS_OF_NETS = ("task.net.", "sampler.")
"""Settings in which the runs of a table of nets may differ."""

OF_RUN = ("m", "seed")
"""Settings of the run that also stand in a sampler inside of the task net, whose stages have sizes
of their own."""


@dataclass(frozen=True)
class Group:
    """Records that one table may show.

    Attributes:
        records: of completed runs.
        about: how they differ from the other groups; empty if there is no other.
        column: what gives the columns of their table: ``m``, ``net``, or the dotted key of a
            setting.
        planes: sampler → the two settings of its heat map; empty for tables by column.
    """

    records: list[RunRecord]
    about: str = ""
    column: str = "m"
    planes: dict[str, list[str]] = field(default_factory=dict)

    @property
    def settings(self) -> list[str]:
        """The dotted settings that give the columns, and the rows of heat maps."""
        keys = {self.column}
        for pair in self.planes.values():
            keys.update(pair)
        return sorted(keys - {"m", "net"})

    @property
    def joint(self) -> bool:
        """Whether a run has a task net of its own, which was trained with the sampler."""
        return any(trained_with(record) == "joint" for record in self.records)


def groups(found: list[RunRecord], mixed: bool = False) -> list[Group]:
    """Split records of tests of samplers into groups that tables may show.

    A table has one task, data set and task net. A net without weights may be in one table with
    a trained net, and tests of the same samplers under several nets are in one table.

    Args:
        found: completed records.
        mixed: whether runs of different commits and settings may be in one table.
    """
    by_net = []
    for group in _split([Group(found)], "task", _task):
        if _tests_several_nets(group):
            by_net.append(replace(group, column="net"))
        else:
            by_net += _split([group], "net", _trained)
    by_data = _by_content(by_net, "data", "dataset_fingerprint")
    comparable = _by_content(by_data, "task weights", "task_weights_sha256")
    if not mixed:
        comparable = _split(comparable, "commit", _commit)
    result = []
    for group in comparable:
        result += _with_layout(group, mixed)
    return result


def _tests_several_nets(group: Group) -> bool:
    """Return whether all runs test samplers again, under several trained nets."""
    are_evaluated = all(record.evaluated for record in group.records)
    if group.joint or not are_evaluated:
        return False
    nets = set()
    for record in group.records:
        if not weightless(record):
            net = collect.names(record)["net"]
            nets.add((net, record.task_weights_sha256))
    return len(nets) > 1


def net_groups(found: list[RunRecord], mixed: bool = False) -> list[Group]:
    """Split records of task nets, which were tested on full clouds, into groups; see ``groups``."""
    by_task = _split([Group(found)], "task", _task_and_dataset)
    sizes = {record.config["dataset"].get("n_points") for record in found}
    if len(sizes) == 1:
        by_task = _by_content(by_task, "data", "dataset_fingerprint")
    if mixed:
        return by_task
    result = []
    for group in _split(by_task, "commit", _commit):
        # A net's settings give it a row of its own.
        keys = [key for key in varying(group.records) if not _is_in_row_of_net(key)]
        rows = [_row(record) for record in group.records]
        result += _by_settings(group, dict.fromkeys(rows, keys))
    return result


def _is_in_row_of_net(key: str) -> bool:
    return key.startswith(IN_ROWS_OF_NETS)


def _split(found: list[Group], what: str, key: Key) -> list[Group]:
    """Split groups by the parts of a key; records whose key is None are in every group.

    Args:
        found: the groups.
        what: what the key is, to describe a group.
        key: of a record.
    """
    result = []
    for group in found:
        by_key: dict[tuple[str, ...], list[RunRecord]] = defaultdict(list)
        shared = []
        for record in group.records:
            texts = key(record)
            if texts is None:
                shared.append(record)
            else:
                by_key[texts].append(record)
        if not by_key:
            result.append(group)
        for texts, records in by_key.items():
            differing = _differing(texts, list(by_key))
            about = _about(group, what, differing)
            part = replace(group, records=[*records, *shared], about=about)
            result.append(part)
    return result


def _differing(texts: tuple[str, ...], keys: list[tuple[str, ...]]) -> list[str]:
    """Return the texts of a key at the places where keys differ."""
    differing = []
    for place, text in enumerate(texts):
        if any(key[place] != text for key in keys):
            differing.append(text)
    return differing


def _about(group: Group, what: str, differing: list[str]) -> str:
    """Return how a part of a group differs from the other groups."""
    if not differing:
        return group.about
    words = differing
    if what:
        words = [what, *differing]
    about = " ".join(word for word in words if word)
    if group.about:
        return f"{group.about}; {about}"
    return about


def _by_content(found: list[Group], what: str, name: str) -> list[Group]:
    """Split groups whose runs differ in data or weights, as a field of the records says.

    It is None where a checkpoint gave the net, or where it has no weights. Seeds may differ in it,
    as with procedural data and nets that are trained first, if every sampler was run with every
    seed.
    """

    def start_of_digest(record: RunRecord) -> tuple[str, ...] | None:
        digest = getattr(record, name)
        if not digest:
            return None
        return (digest[:12],)

    result = []
    for group in found:
        has_several_nets = group.column == "net" or group.joint
        may_differ = name == "task_weights_sha256" and has_several_nets
        if may_differ or _agree(group.records, name):
            result.append(group)
        else:
            result += _split([group], what, start_of_digest)
    return result


def _agree(found: list[RunRecord], name: str) -> bool:
    """Return whether runs have the same value of a field, or one for each seed of all samplers."""
    runs = pd.DataFrame(
        {
            "sampler": [collect.names(record)["sampler"] for record in found],
            "seed": [seed(record) for record in found],
            "value": [getattr(record, name) for record in found],
        }
    ).dropna()
    if runs["value"].nunique() <= 1:
        return True
    seeds_of_samplers = runs.groupby("sampler")["seed"].agg(frozenset)
    values_of_seeds = runs.groupby("seed")["value"].nunique()
    return seeds_of_samplers.nunique() == 1 and (values_of_seeds == 1).all()


def _with_layout(group: Group, mixed: bool) -> list[Group]:
    """Choose the layout of a group's table.

    If runs of one sampler differ in size and seed only, columns are sizes. If they differ in one
    other setting, columns are its values; if in two, each sampler gets a heat map. A group that
    differs in more is split, unless ``mixed``.
    """
    rows: dict[Row, list[RunRecord]] = defaultdict(list)
    for record in group.records:
        rows[_row(record)].append(record)
    different = {row: varying(records) for row, records in rows.items()}
    keys = set()
    for of_row in different.values():
        keys.update(of_row)
    if group.column == "net" or not keys:
        return [group]
    column = _column(group, keys)
    planes = _planes(rows, different)
    if column is None and planes is None:
        if mixed:
            return [group]
        return _by_settings(group, different)
    sizes = {record.config["m"] for record in group.records}
    if len(sizes) > 1:
        if mixed:
            return [group]
        return _by_size(group)
    if column is not None:
        return [replace(group, column=column)]
    assert planes is not None
    return [replace(group, planes=planes)]


def _column(group: Group, keys: set[str]) -> str | None:
    """Return the only setting in which the runs of rows differ, if its values make columns."""
    if len(keys) != 1:
        return None
    (key,) = keys
    if key in OF_TEST_CLOUDS or _are_numbers(group.records, [key]):
        return key
    return None


def _planes(
    rows: dict[Row, list[RunRecord]], different: dict[Row, list[str]]
) -> dict[str, list[str]] | None:
    """Return the two settings in which the runs of each sampler differ; None if one has others.

    Args:
        rows: the runs of every row.
        different: the settings in which they differ.
    """
    planes = {}
    for row, keys in different.items():
        if len(keys) != 2 or not _are_numbers(rows[row], keys):
            return None
        sampler, _ = row
        planes[sampler] = keys
    return planes


def _by_size(group: Group) -> list[Group]:
    """Split a group by the sizes of its runs, and choose the layouts of the tables."""
    result = []
    for part in _split([group], "m", _size):
        result += _with_layout(part, mixed=False)
    return result


def _size(record: RunRecord) -> tuple[str, ...]:
    return (str(record.config["m"]),)


def _by_settings(group: Group, different: dict[Row, list[str]]) -> list[Group]:
    """Split a group by the settings in which the runs of a row differ; other rows are shared."""

    def about(record: RunRecord) -> tuple[str, ...] | None:
        texts = [f"{key}={value(record, key)}" for key in different[_row(record)]]
        if not texts:
            return None
        return (", ".join(texts),)

    parts = _split([group], "", about)
    return sorted(parts, key=lambda part: part.about)


def varying(found: list[RunRecord]) -> list[str]:
    """Return the dotted settings in which records of one sampler differ."""
    runs = [(considered(record), record.evaluated is not None) for record in found]
    keys: set[str] = set()
    for of_run, _ in runs:
        keys.update(of_run)
    different = []
    for key in keys:
        texts = set()
        for of_run, is_evaluated in runs:
            if key in of_run or not is_evaluated:  # a test does not know how its run was trained
                texts.add(text_to_compare(of_run.get(key)))
        if len(texts) > 1:
            different.append(key)
    return sorted(different)


def considered(record: RunRecord) -> dict[str, Any]:
    """Return the settings that are compared, with dotted keys, and the epochs trained.

    Those of a test of a trained run are the run's, but for settings that ``evaluate=RUN`` does not
    take from it, such as the optimizer: they are left out.
    """
    learn = record.config["learn"]
    if record.evaluated:
        learn = record.evaluated.learn
    compared = table_settings(record.config, learn)
    if record.evaluated:
        compared = {key: value for key, value in compared.items() if declaration(key).repeated}
    compared |= dotted(recorded_recipe(record), "recipe")
    compared["trainer.max_epochs"] = epochs(record)
    return compared


def value(record: RunRecord, key: str) -> Any:
    """Return a dotted setting of a record."""
    return considered(record).get(key)


def weightless(record: RunRecord) -> bool:
    """Return whether the task net has no weights: none are recorded, and none were trained."""
    trains = record.config["learn"] in ("task", "joint")
    return not trains and record.task_weights_sha256 is None


def _row(record: RunRecord) -> Row:
    return sampler_row(record), collect.names(record)["net"]


def _task(record: RunRecord) -> tuple[str, ...]:
    resample = record.config["task"].get("resample")
    return *_task_and_dataset(record), f"resample={resample}"


def _task_and_dataset(record: RunRecord) -> tuple[str, ...]:
    names = collect.names(record)
    return names["task"], names["dataset"]


def _trained(record: RunRecord) -> tuple[str, ...] | None:
    """Return what the task nets of a table share; None for a net without weights."""
    if weightless(record):
        return None
    settings = json.dumps(_settings_of_net(record), sort_keys=True)
    name = collect.names(record)["net"]
    return name, f"task.net={settings}", f"learn={trained_with(record)}"


def _settings_of_net(record: RunRecord) -> Any:
    """Return the settings of a record's task net, without those of the run that are in it."""
    net = with_defaults(record.config["task"].get("net"))
    if not isinstance(net, dict) or not isinstance(net.get("sampler"), dict):
        return net
    inside = {**net["sampler"]}
    for name in OF_RUN:
        inside.pop(name, None)
    return {**net, "sampler": inside}


def _commit(record: RunRecord) -> tuple[str, ...]:
    return (commit(record),)


def commit(record: RunRecord) -> str:
    """Return the short commit of the code that made a record."""
    full = record.git["commit"] or "unknown"
    return full[:10]


def _are_numbers(found: list[RunRecord], keys: list[str]) -> bool:
    """Return whether the values of settings are numbers in all records."""
    for record in found:
        settings = considered(record)
        if not all(_is_number(settings.get(key)) for key in keys):
            return False
    return True


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
