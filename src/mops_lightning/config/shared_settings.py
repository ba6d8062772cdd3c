"""The settings that two runs must share: to resume one, to reuse a net, to make one table."""

from collections.abc import Mapping
from dataclasses import asdict, fields
from functools import cache
from typing import Any

from mops_lightning.config import settings
from mops_lightning.config.build import signature
from mops_lightning.errors import UserError
from mops_lightning.tree import dotted

OWN = "mops_lightning."
"""Package of the classes whose defaults are known; a record's other classes are not imported."""
FROM_DATA = ("point_channels",)
"""Arguments with a default that a run fills in from its data; ``dataset.features`` decides them."""


def effective(config: Mapping[str, Any], learn: str) -> dict[str, Any]:
    """Return the dotted settings that count with ``learn``.

    Args:
        config: plain data, such as a record's.
        learn: what is trained. Of a setting with an entry for it, only this entry counts.
    """
    flat: dict[str, Any] = {}
    for name, node in config.items():
        if settings.of(name).per_learn and isinstance(node, dict):
            trained = "task" if learn == "task" else "sampler"
            node = node.get(trained)
            if node is None:  # no augmentation
                continue
        for path, value in dotted(node, name).items():
            if settings.of(path).counts(learn):
                flat[path] = value
    return flat


def training_settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the dotted settings that affect what a run learns.

    Left out are those that are identified by the content of files; see ``Setting.by_content``.
    """
    identifying = {}
    for path, value in effective(config, config["learn"]).items():
        setting = settings.of(path)
        if setting.affects_training and not setting.by_content:
            identifying[path] = value
    return identifying


def table_settings(config: Mapping[str, Any], learn: str) -> dict[str, Any]:
    """Return the dotted settings in which the runs of one table must not differ.

    A setting that is newer than the record has its default value.
    """
    from mops_lightning.data.loader import Augmentation  # imports torch

    no_augmentation = asdict(Augmentation())
    defaults: dict[str, Any] = {}
    for declaration in fields(settings.SCHEMA):
        is_group = declaration.metadata["setting"].group
        if declaration.default is not None and not is_group:
            defaults[declaration.name] = declaration.default
    defaults["augment"] = {"task": no_augmentation, "sampler": no_augmentation}
    known = {name: node for name, node in config.items() if name in settings.declared()}
    values = effective(defaults, learn)
    values |= effective(with_defaults(known), learn)
    return {path: value for path, value in values.items() if settings.of(path).compared}


def with_defaults(node: Any) -> Any:
    """Return settings with the defaults of their classes for arguments that they do not set.

    Args:
        node: plain data; a part with ``_target_`` describes an object.
    """
    if not isinstance(node, dict):
        return node
    filled = {}
    if "_target_" in node:
        filled.update(_defaults(str(node["_target_"])))
    for name, child in node.items():
        filled[name] = with_defaults(child)
    return filled


@cache
def _defaults(target: str) -> dict[str, Any]:
    """Return the plain defaults of a class or function of this package."""
    if not target.startswith(OWN):
        return {}
    try:
        parameters = signature(target, "")
    except UserError:  # an earlier version had it
        return {}
    defaults = {}
    for name, parameter in parameters.items():
        value = parameter.default
        if value is parameter.empty or name in FROM_DATA:
            continue
        if isinstance(value, tuple):  # as YAML has it
            value = list(value)
        defaults[name] = value
    return defaults
