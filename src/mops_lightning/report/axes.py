"""In which settings the runs of one table differ, and what its columns therefore are."""

from dataclasses import dataclass
from typing import Any

from mops_lightning.errors import UserError
from mops_lightning.records.run_record import dotted
from mops_lightning.report.collect import Record, epochs

CONSIDERED = ("sampler", "optimizer", "task", "augment", "batch_size", "noise", "task_rate")
"""Settings that may change a figure and are not compared as a whole; see ``collect.common``."""

SIZES = ("sampler.m", "sampler.m_max", "sampler.seed")
"""What differs between the cells of one row, or between seeds."""


@dataclass(frozen=True)
class Axes:
    """How a table is laid out.

    Attributes:
        column: the setting that columns stand for: ``m``, or another dotted key.
        planes: sampler → the two settings of its heat map; empty for tables by column.
    """

    column: str = "m"
    planes: dict[str, tuple[str, str]] | None = None


def axes(found: list[Record], net: str, mixed: bool = False) -> Axes:
    """Find out what a table of these records shows.

    Runs of one sampler that differ in nothing but size and seed make a table by size. One more
    setting takes the place of the size; two make a heat map for each sampler.

    Args:
        found: completed records of samplers' tests.
        net: the table's task net.
        mixed: whether runs that differ in other settings may stand in one table.

    Raises:
        UserError: the records differ in too much; it says in what.
    """
    names = {row(record, net) for record in found}
    different = {name: varying([r for r in found if row(r, net) == name]) for name in sorted(names)}
    keys = {key for one in different.values() for key in one}
    if not keys:
        return Axes()
    numbers = {key for key in keys if _numeric(found, key)}
    line = len(keys) == 1 and numbers == keys
    plane = all(len(one) == 2 and set(one) <= numbers for one in different.values())
    sizes = sorted({record["config"]["m"] for record in found})
    if (line or plane) and len(sizes) > 1:
        if mixed:
            return Axes()
        raise UserError(
            f"The runs differ in size (m={', m='.join(map(str, sizes))}) and in "
            f"{', '.join(sorted(keys))}. Give a folder with runs of one size, or, if their figures "
            "may stand in one table all the same, add --mixed."
        )
    if line:
        return Axes(column=min(keys))
    if plane:
        return Axes(planes={name: (one[0], one[1]) for name, one in different.items()})
    if mixed:
        return Axes()
    listed = "; ".join(f"{name}: {', '.join(one)}" for name, one in different.items() if one)
    raise UserError(
        f"The runs of one sampler differ in their settings ({listed}). Give a folder with runs of "
        "one kind, or, if their figures may stand in one table all the same, add --mixed."
    )


def varying(found: list[Record]) -> list[str]:
    """Return the dotted settings in which records of one sampler differ."""
    flat = [considered(record) for record in found]
    keys = sorted({key for one in flat for key in one})
    return [key for key in keys if len({repr(one.get(key)) for one in flat}) > 1]


def considered(record: Record) -> dict[str, Any]:
    """Return the settings that count, dotted, and the epochs under their name."""
    config = record["config"]
    learn = (record["notes"].get("evaluated") or {}).get("learn", config["learn"])
    nodes = {key: config[key] for key in CONSIDERED if key in config}
    if isinstance(nodes.get("augment"), dict):
        nodes["augment"] = nodes["augment"].get(learn)
    nodes.setdefault("noise", 0.0)  # records from before there was noise
    return {
        **{key: value for key, value in dotted(nodes).items() if key not in SIZES},
        "trainer.max_epochs": epochs(record),
    }


def value(record: Record, key: str) -> Any:
    """Return a dotted setting of a record."""
    return record["config"]["m"] if key == "m" else considered(record).get(key)


def row(record: Record, net: str) -> str:
    """Return the row of a record's own figures; another net than the table's is named in it."""
    names = record["config"]["names"]
    return names["sampler"] if names["net"] == net else f"{names['net']} on {names['sampler']}"


def _numeric(found: list[Record], key: str) -> bool:
    values = [considered(record).get(key) for record in found if key in considered(record)]
    return all(isinstance(one, int | float) and not isinstance(one, bool) for one in values)
