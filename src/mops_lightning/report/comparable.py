"""Which runs one table may show: groups of comparable records, and the layout of their tables."""

import json
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field, replace
from typing import Any

import pandas as pd

from mops_lightning.config.shared_settings import table_settings
from mops_lightning.records.run_record import RunRecord, dotted
from mops_lightning.report.collect import epochs, recorded_recipe, sampler_row, seed, trained_with


@dataclass(frozen=True)
class Layout:
    """The layout of a table.

    Attributes:
        column: what gives the columns: ``m``, ``net``, or the dotted key of a setting.
        planes: sampler → the two settings of its heat map; empty for tables by column.
    """

    column: str = "m"
    planes: dict[str, tuple[str, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class Group:
    """Records that one table may show.

    Attributes:
        records: of completed runs.
        about: how they differ from the other groups; empty if there is no other.
        layout: of their table.
    """

    records: list[RunRecord]
    about: str = ""
    layout: Layout = Layout()


def groups(found: list[RunRecord], mixed: bool = False) -> list[Group]:
    """Split records of tests of samplers into groups that tables may show.

    A table has one task, data set and task net. A net without weights, such as ICP, may be in one
    table with a trained net, and tests of the same samplers under several nets are in one table.

    Args:
        found: completed records.
        mixed: whether runs of different commits and settings may be in one table.
    """
    result = []
    for group in _split([Group(found)], "task", _task):
        nets = {_net(record) for record in group.records if not weightless(record)}
        joint = any(trained_with(record) == "joint" for record in group.records)
        if len(nets) > 1 and not joint and all(record.evaluated for record in group.records):
            result.append(Group(group.records, group.about, Layout("net")))
            continue
        shared = [record for record in group.records if weightless(record)]
        own = [record for record in group.records if not weightless(record)]
        split = _split([Group(own, group.about)], "net", _trained) if own else [Group([])]
        result += [Group([*one.records, *shared], one.about or group.about) for one in split]
    result = _by_content(result, "data", "dataset_fingerprint")
    result = _by_content(result, "task weights", "task_weights_sha256")
    if not mixed:
        result = _split(result, "commit", commit)
    return [one for group in result for one in _with_layout(group, mixed)]


def net_groups(found: list[RunRecord], mixed: bool = False) -> list[Group]:
    """Split records of task nets, which were tested on full clouds, into groups; see ``groups``."""
    result = _split([Group(found)], "task", lambda record: _names(record, "task", "dataset"))
    points = {record.config["dataset"].get("n_points") for record in found}
    result = _by_content(result, "data", "dataset_fingerprint") if len(points) == 1 else result
    if mixed:
        return result
    parts = []
    for group in _split(result, "commit", commit):
        keys = varying(group.records)
        keys = [key for key in keys if not key.startswith(("task.net.", "sampler."))]
        parts += _by_settings(group, keys)
    return parts


def _split(found: list[Group], what: str, key: Callable[[RunRecord], Hashable]) -> list[Group]:
    """Split groups by a value of their records, in the order of their first records."""
    result = []
    for group in found:
        parts: dict[Hashable, list[RunRecord]] = {}
        for record in group.records:
            parts.setdefault(key(record), []).append(record)
        for value, records in parts.items():
            text = value if isinstance(value, str) else " ".join(map(str, _differing(value, parts)))
            result.append(_part(group, f"{what} {text}" if len(parts) > 1 else "", records))
    return result


def _differing(value: Any, others: Any) -> list[Any]:
    """Return the parts of a key that differ from other keys."""
    return [part for i, part in enumerate(value) if len({other[i] for other in others}) > 1]


def _by_content(found: list[Group], what: str, name: str) -> list[Group]:
    """Split groups whose runs differ in data or weights, as a field of the records says.

    Seeds may differ in it, as with procedural data and nets that are trained first, if every
    sampler was run with every seed. Joint training gives each run its own task net.
    """
    result = []
    for group in found:
        several_nets = group.layout.column == "net" or any(
            trained_with(record) == "joint" for record in group.records
        )
        # None where a checkpoint gave the net, or where it has no weights.
        known = [record for record in group.records if getattr(record, name)]
        if (several_nets and name == "task_weights_sha256") or _agree(known, name):
            result.append(group)
            continue
        unknown = [record for record in group.records if not getattr(record, name)]
        parts = _split([replace(group, records=known)], what, lambda one: getattr(one, name)[:12])
        result += [replace(part, records=[*part.records, *unknown]) for part in parts]
    return result


def _agree(found: list[RunRecord], name: str) -> bool:
    """Return whether runs have the same value of a field, or one for each seed of all samplers."""
    rows = [(one.config["names"]["sampler"], seed(one), getattr(one, name)) for one in found]
    runs = pd.DataFrame(rows, columns=["sampler", "seed", "value"])
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
    if group.layout.column == "net":
        return [group]
    rows: dict[str, list[RunRecord]] = {}
    for record in group.records:
        rows.setdefault(f"{sampler_row(record)} {_names(record, 'net')}", []).append(record)
    different = {name: varying(records) for name, records in rows.items()}
    keys = sorted({key for one in different.values() for key in one})
    if not keys:
        return [group]
    line = len(keys) == 1 and _numeric(group.records, keys)
    plane = all(len(one) == 2 and _numeric(rows[name], one) for name, one in different.items())
    sizes = {record.config["m"] for record in group.records}
    if mixed and (len(sizes) > 1 or not (line or plane)):
        return [group]
    if line or plane:
        planes = {sampler_row(one[0]): tuple(different[name]) for name, one in rows.items()}
        layout = Layout(keys[0]) if line else Layout("", planes)
        if len(sizes) == 1:
            return [replace(group, layout=layout)]
        parts = _split([group], "m", lambda record: str(record.config["m"]))
        return [one for part in parts for one in _with_layout(part, mixed)]
    return _by_settings(group, keys)


def _by_settings(group: Group, keys: list[str]) -> list[Group]:
    """Split a group by settings; samplers whose runs agree in them are in every part."""
    shared: list[RunRecord] = []
    rows: dict[str, list[RunRecord]] = {}
    for record in group.records:
        rows.setdefault(sampler_row(record), []).append(record)
    parts: dict[str, list[RunRecord]] = {}
    for records in rows.values():
        own = [key for key in keys if key in varying(records)]
        if not own:
            shared += records
        for record in records if own else ():
            about = ", ".join(f"{key}={value(record, key)}" for key in own)
            parts.setdefault(about, []).append(record)
    if not parts:
        return [group]
    return [_part(group, about, [*own, *shared]) for about, own in sorted(parts.items())]


def _part(group: Group, about: str, records: list[RunRecord]) -> Group:
    """Return a part of a group."""
    return replace(group, records=records, about="; ".join(filter(None, (group.about, about))))


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
    return record.config["m"] if key == "m" else considered(record).get(key)


def commit(record: RunRecord) -> str:
    """Return the short commit of the code that made a record."""
    return (record.git["commit"] or "unknown")[:10]


def weightless(record: RunRecord) -> bool:
    """Return whether the task net has no weights: none are recorded, and none were trained."""
    trains = record.config["learn"] in ("task", "joint")
    return not trains and record.task_weights_sha256 is None


def _task(record: RunRecord) -> tuple[str, ...]:
    pairs = record.config["task"].get("pairs")
    return (*_names(record, "task", "dataset"), f"pairs={json.dumps(pairs, sort_keys=True)}")


def _net(record: RunRecord) -> tuple[str | None, ...]:
    return (*_names(record, "net"), record.task_weights_sha256)


def _trained(record: RunRecord) -> tuple[str, ...]:
    """Return what the task nets of a table share."""
    task, learned = record.config["task"], trained_with(record)
    loss = f"loss={json.dumps(task.get('loss'), sort_keys=True)}" if learned == "joint" else ""
    settings = f"task.net={json.dumps(task.get('net'), sort_keys=True)}"
    return (*_names(record, "net"), settings, f"learn={learned}", loss)


def _names(record: RunRecord, *groups: str) -> tuple[str, ...]:
    return tuple(record.config["names"][group] for group in groups)


def _numeric(found: list[RunRecord], keys: list[str]) -> bool:
    values = [considered(record).get(key) for record in found for key in keys]
    return all(isinstance(one, int | float) and not isinstance(one, bool) for one in values)


def _text(value: Any) -> str:
    """Return a value as text; numbers that are equal give the same text."""
    return repr(float(value)) if type(value) is int else repr(value)
