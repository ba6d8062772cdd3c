"""The settings that two runs must share: to resume one, to reuse a net, to make one table."""

from collections.abc import Mapping
from dataclasses import asdict, fields
from functools import cache
from typing import Any

from mops_lightning.config import settings
from mops_lightning.config.build import signature
from mops_lightning.config.settings import Affects
from mops_lightning.errors import UserError
from mops_lightning.tree import dotted

OWN = "mops_lightning."
"""Package of the classes whose defaults are known; a record's other classes are not imported."""


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
            if node is None:  # no augmentation
                continue
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
    """Return the dotted settings in which the runs of one table must not differ.

    A setting that is newer than the record has its default value.
    """
    from mops_lightning.data.loader import Augmentation  # imports torch

    defaults: dict[str, Any] = {
        one.name: one.default
        for one in fields(settings.SCHEMA)
        if one.default is not None and not one.metadata["setting"].group
    }
    known = {name: node for name, node in config.items() if name in settings.declared()}
    defaults["augment"] = dict.fromkeys(("task", "sampler"), asdict(Augmentation()))
    flat = effective(defaults, learn) | effective(with_defaults(known), learn)
    return {path: value for path, value in flat.items() if settings.of(path).compared}


def with_defaults(node: Any) -> Any:
    """Return settings with the defaults of their classes for arguments that they do not set.

    Args:
        node: plain data; a part with ``_target_`` describes an object.
    """
    if not isinstance(node, dict):
        return node
    filled = {name: with_defaults(child) for name, child in node.items()}
    return {**_defaults(str(node["_target_"])), **filled} if "_target_" in node else filled


@cache
def _defaults(target: str) -> dict[str, Any]:
    """Return the plain defaults of a class or function of this package."""
    if not target.startswith(OWN):
        return {}
    try:
        parameters = signature(target, "")
    except UserError:  # an earlier version had it
        return {}
    plain = {name: one.default for name, one in parameters.items() if one.default is not one.empty}
    return {
        name: list(value) if isinstance(value, tuple) else value for name, value in plain.items()
    }
