"""The settings that two runs must share: to resume one, to reuse a net, to make one table."""

from collections.abc import Mapping
from typing import Any

from mops_lightning.config import settings
from mops_lightning.config.settings import Affects
from mops_lightning.records.run_record import dotted


def effective(config: Mapping[str, Any], learn: str) -> dict[str, Any]:
    """Return the dotted settings that count with ``learn``.

    Args:
        config: plain data, such as a record's.
        learn: what is trained. Of a setting with an entry for it, only this entry counts.
    """
    flat: dict[str, Any] = {}
    for name, node in config.items():
        if settings.of(name).per_learn and isinstance(node, dict):
            node = node.get("task" if learn == "task" else "sampler")
        flat |= dotted(node, name)
    return {path: value for path, value in flat.items() if settings.of(path).counts(learn)}


def training_settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the dotted settings that affect what a run learns.

    Left out are those that are identified by the content of files; see ``Setting.by_content``.
    """
    return {
        path: value
        for path, value in effective(config, config["learn"]).items()
        if Affects.TRAINING in settings.of(path).affects and not settings.of(path).by_content
    }


def table_settings(config: Mapping[str, Any], learn: str) -> dict[str, Any]:
    """Return the dotted settings in which the runs of one table must not differ."""
    known = {name: node for name, node in config.items() if name in settings.declared()}
    flat = effective(known, learn)
    return {path: value for path, value in flat.items() if settings.of(path).compared}
