"""Find the settings in which runs differ, and with them the layout of a table."""

from dataclasses import dataclass
from typing import Any

from mops_lightning.config.shared_settings import table_settings
from mops_lightning.errors import UserError
from mops_lightning.records.run_record import RunRecord, dotted
from mops_lightning.report.collect import epochs, recipe, sampler_row


@dataclass(frozen=True)
class Axes:
    """The layout of a table.

    Attributes:
        column: the setting that gives the columns: ``m``, or another dotted key.
        planes: sampler → the two settings of its heat map; None for tables by column.
    """

    column: str = "m"
    planes: dict[str, tuple[str, str]] | None = None


def axes(found: list[RunRecord], net: str, mixed: bool = False) -> Axes:
    """Choose the layout of a table of these records.

    If runs of one sampler differ in size and seed only, columns are sizes. If they differ in one
    other setting, columns are its values; if in two, each sampler gets a heat map.

    Args:
        found: completed records of tests of samplers.
        net: the table's task net.
        mixed: whether runs that differ in other settings are allowed in one table.

    Raises:
        UserError: the runs differ in more settings, which the error names.
    """
    names = {row(record, net) for record in found}
    different = {name: varying([r for r in found if row(r, net) == name]) for name in sorted(names)}
    keys = {key for one in different.values() for key in one}
    if not keys:
        return Axes()
    numbers = {key for key in keys if _numeric(found, key)}
    line = len(keys) == 1 and numbers == keys
    plane = all(len(one) == 2 and set(one) <= numbers for one in different.values())
    sizes = sorted({record.config["m"] for record in found})
    if (line or plane) and len(sizes) > 1:
        if mixed:
            return Axes()
        raise UserError(
            f"The runs differ in size (m={', m='.join(map(str, sizes))}) and in "
            f"{', '.join(sorted(keys))}. Give a folder with runs of one size, or add --mixed to "
            "show them in one table."
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
        "the same settings, or add --mixed to show them in one table."
    )


def varying(found: list[RunRecord]) -> list[str]:
    """Return the dotted settings in which records of one sampler differ."""
    flat = [considered(record) for record in found]
    keys = sorted({key for one in flat for key in one})
    return [key for key in keys if len({_text(one.get(key)) for one in flat}) > 1]


def considered(record: RunRecord) -> dict[str, Any]:
    """Return the settings that are compared, with dotted keys, and the epochs trained."""
    config = record.config
    learn = record.evaluated.learn if record.evaluated else config["learn"]
    settings = {**table_settings(config, learn), **dotted(recipe(record), "recipe")}
    return {**settings, "trainer.max_epochs": epochs(record)}


def value(record: RunRecord, key: str) -> Any:
    """Return a dotted setting of a record."""
    return record.config["m"] if key == "m" else considered(record).get(key)


def row(record: RunRecord, net: str) -> str:
    """Return the row of a record's own results; it names a net that is not the table's."""
    names = record.config["names"]
    sampler = sampler_row(record)
    return sampler if names["net"] == net else f"{names['net']} on {sampler}"


def _numeric(found: list[RunRecord], key: str) -> bool:
    values = [considered(record).get(key) for record in found if key in considered(record)]
    return all(isinstance(one, int | float) and not isinstance(one, bool) for one in values)


def _text(value: Any) -> str:
    """Return a value as text; numbers that are equal give the same text."""
    return repr(float(value)) if type(value) is int else repr(value)
