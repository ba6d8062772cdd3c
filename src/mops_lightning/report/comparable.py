"""Which runs one table may show: groups of comparable records, and the layout of their tables."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import pandas as pd

from mops_lightning.config.shared_settings import table_settings, with_defaults
from mops_lightning.records.run_record import RunRecord
from mops_lightning.records.summary import OF_TEST_CLOUDS
from mops_lightning.report import collect
from mops_lightning.report.collect import epochs, recorded_recipe, sampler_row, seed, trained_with
from mops_lightning.tree import dotted


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
        keys = {key for pair in self.planes.values() for key in pair} | {self.column}
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
    result = []
    for group in _split([Group(found)], "task", _task):
        trained = [record for record in group.records if not weightless(record)]
        nets = {(collect.names(record)["net"], record.task_weights_sha256) for record in trained}
        if len(nets) > 1 and not group.joint and all(one.evaluated for one in group.records):
            result.append(replace(group, column="net"))
        else:
            result += _split([group], "net", _trained)
    result = _by_content(result, "data", "dataset_fingerprint")
    result = _by_content(result, "task weights", "task_weights_sha256")
    if not mixed:
        result = _split(result, "commit", lambda record: (commit(record),))
    return [one for group in result for one in _with_layout(group, mixed)]


def net_groups(found: list[RunRecord], mixed: bool = False) -> list[Group]:
    """Split records of task nets, which were tested on full clouds, into groups; see ``groups``."""
    result = _split([Group(found)], "task", lambda record: _task(record)[:2])
    if len({record.config["dataset"].get("n_points") for record in found}) == 1:
        result = _by_content(result, "data", "dataset_fingerprint")
    if mixed:
        return result
    parts = []
    for group in _split(result, "commit", lambda record: (commit(record),)):
        keys = varying(group.records)
        keys = [key for key in keys if not key.startswith(("task.net.", "sampler."))]
        parts += _by_settings(group, dict.fromkeys(map(_row, group.records), keys))
    return parts


def _split(
    found: list[Group], what: str, key: Callable[[RunRecord], tuple[str, ...] | None]
) -> list[Group]:
    """Split groups by the parts of a key; records whose key is None are in every group.

    Args:
        found: the groups.
        what: what the key is, to describe a group.
        key: of a record.
    """
    result = []
    for group in found:
        parts: dict[Any, list[RunRecord]] = {}
        for record in group.records:
            parts.setdefault(key(record), []).append(record)
        shared = parts.pop(None, [])
        for part, records in parts.items():
            about = _about(group, what, _differing(part, list(parts)))
            result.append(replace(group, records=[*records, *shared], about=about))
        if not parts:
            result.append(group)
    return result


def _differing(part: tuple[str, ...], parts: list[tuple[str, ...]]) -> list[str]:
    """Return the texts of a key at the places where keys differ."""
    places = zip(*parts, strict=True)
    return [text for text, texts in zip(part, places, strict=True) if len(set(texts)) > 1]


def _about(group: Group, what: str, differing: list[str]) -> str:
    """Return how a part of a group differs from the other groups."""
    if not differing:
        return group.about
    texts = [text for text in (what, *differing) if text]
    about = " ".join(texts)
    return f"{group.about}; {about}" if group.about else about


def _by_content(found: list[Group], what: str, name: str) -> list[Group]:
    """Split groups whose runs differ in data or weights, as a field of the records says.

    It is None where a checkpoint gave the net, or where it has no weights. Seeds may differ in it,
    as with procedural data and nets that are trained first, if every sampler was run with every
    seed.
    """

    def start_of_digest(record: RunRecord) -> tuple[str, ...] | None:
        digest = getattr(record, name)
        return (digest[:12],) if digest else None

    result = []
    for group in found:
        several_nets = name == "task_weights_sha256" and (group.column == "net" or group.joint)
        if several_nets or _agree(group.records, name):
            result.append(group)
        else:
            result += _split([group], what, start_of_digest)
    return result


def _agree(found: list[RunRecord], name: str) -> bool:
    """Return whether runs have the same value of a field, or one for each seed of all samplers."""
    rows = [(collect.names(one)["sampler"], seed(one), getattr(one, name)) for one in found]
    runs = pd.DataFrame(rows, columns=["sampler", "seed", "value"]).dropna()
    if runs["value"].nunique() <= 1:
        return True
    seeds = runs.groupby("sampler")["seed"].agg(frozenset)
    return seeds.nunique() == 1 and (runs.groupby("seed")["value"].nunique() == 1).all()


def _with_layout(group: Group, mixed: bool) -> list[Group]:
    """Choose the layout of a group's table.

    If runs of one sampler differ in size and seed only, columns are sizes. If they differ in one
    other setting, columns are its values; if in two, each sampler gets a heat map. A group that
    differs in more is split, unless ``mixed``.
    """
    rows: dict[tuple[str, str], list[RunRecord]] = {}
    for record in group.records:
        rows.setdefault(_row(record), []).append(record)
    different = {row: varying(records) for row, records in rows.items()}
    keys = sorted({key for one in different.values() for key in one})
    if group.column == "net" or not keys:
        return [group]
    line = len(keys) == 1 and (_numeric(group.records, keys) or keys[0] in OF_TEST_CLOUDS)
    plane = all(len(one) == 2 and _numeric(rows[row], one) for row, one in different.items())
    sizes = {record.config["m"] for record in group.records}
    if mixed and (len(sizes) > 1 or not (line or plane)):
        return [group]
    if not (line or plane):
        return _by_settings(group, different)
    if len(sizes) > 1:
        parts = _split([group], "m", lambda record: (str(record.config["m"]),))
        return [one for part in parts for one in _with_layout(part, mixed)]
    if line:
        return [replace(group, column=keys[0])]
    return [replace(group, planes={sampler: pair for (sampler, _), pair in different.items()})]


def _by_settings(group: Group, different: dict[tuple[str, str], list[str]]) -> list[Group]:
    """Split a group by the settings in which the runs of a row differ; other rows are shared."""

    def about(record: RunRecord) -> tuple[str, ...] | None:
        texts = [f"{key}={value(record, key)}" for key in different[_row(record)]]
        return (", ".join(texts),) if texts else None

    return sorted(_split([group], "", about), key=lambda part: part.about)


def varying(found: list[RunRecord]) -> list[str]:
    """Return the dotted settings in which records of one sampler differ."""
    flat = [considered(record) for record in found]
    keys = sorted({key for one in flat for key in one})
    return [key for key in keys if len({_text(one.get(key)) for one in flat}) > 1]


def considered(record: RunRecord) -> dict[str, Any]:
    """Return the settings that are compared, with dotted keys, and the epochs trained."""
    learn = record.evaluated.learn if record.evaluated else record.config["learn"]
    settings = {**table_settings(record.config, learn), **dotted(recorded_recipe(record), "recipe")}
    return {**settings, "trainer.max_epochs": epochs(record)}


def value(record: RunRecord, key: str) -> Any:
    """Return a dotted setting of a record."""
    return considered(record).get(key)


def weightless(record: RunRecord) -> bool:
    """Return whether the task net has no weights: none are recorded, and none were trained."""
    trains = record.config["learn"] in ("task", "joint")
    return not trains and record.task_weights_sha256 is None


def _row(record: RunRecord) -> tuple[str, str]:
    return sampler_row(record), collect.names(record)["net"]


def _task(record: RunRecord) -> tuple[str, ...]:
    names = collect.names(record)
    return names["task"], names["dataset"], f"resample={record.config['task'].get('resample')}"


def _trained(record: RunRecord) -> tuple[str, ...] | None:
    """Return what the task nets of a table share; None for a net without weights."""
    if weightless(record):
        return None
    task = record.config["task"]
    learned = trained_with(record)
    settings = f"task.net={json.dumps(with_defaults(task.get('net')), sort_keys=True)}"
    return collect.names(record)["net"], settings, f"learn={learned}"


def commit(record: RunRecord) -> str:
    """Return the short commit of the code that made a record."""
    return (record.git["commit"] or "unknown")[:10]


def _numeric(found: list[RunRecord], keys: list[str]) -> bool:
    values = [value(record, key) for record in found for key in keys]
    return all(isinstance(one, int | float) and not isinstance(one, bool) for one in values)


def _text(value: Any) -> str:
    """Return a value as text; numbers that are equal give the same text."""
    return repr(float(value)) if type(value) is int else repr(value)
