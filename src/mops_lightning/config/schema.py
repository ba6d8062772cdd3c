"""A JSON schema of the configuration, for editors of YAML files."""

import json
import types
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from omegaconf import OmegaConf

from mops_lightning.config import settings
from mops_lightning.config.annotations import LISTS
from mops_lightning.config.build import signature
from mops_lightning.config.composition import conf_dir
from mops_lightning.errors import UserError

Schema = dict[str, Any]

PLAIN: dict[Any, str] = {
    int: "integer",
    float: "number",
    bool: "boolean",
    str: "string",
    type(None): "null",
}
INTERPOLATION = {"$ref": "#/definitions/interpolation"}
OPEN = ("callbacks", "baselines", "logger", "trainer")
"""Groups that take settings of classes of other packages, or further entries of any name."""


def schema() -> Schema:
    """Return the JSON schema of files below ``conf/experiment``, ``sweeps`` and the like."""
    hints = get_type_hints(settings.SCHEMA)
    groups = choices()
    properties: Schema = {
        "defaults": {"type": "array", "items": {"anyOf": [{"type": "string"}, _default(groups)]}},
        "hydra": {"type": "object", "description": "Hydra's own settings"},
    }
    for one in fields(settings.SCHEMA):
        setting = settings.declared()[one.name]
        if setting.group:
            properties[one.name] = _group(one.name)
            continue
        limits = setting.limits
        own = {"enum": list(limits.choices)} if limits and limits.choices else None
        described = setting.help + (f" ({limits.allowed})" if limits else "")
        properties[one.name] = {
            **_or_interpolation(own or _typed(hints[one.name])),
            "description": described,
            **({"default": one.default} if one.default is not None else {}),
        }
    properties |= _on_demand()
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "mops_lightning configuration",
        "type": "object",
        "properties": properties,
        "additionalProperties": False,
        "definitions": {"interpolation": {"type": "string", "pattern": r"\$\{"}},
    }


def _on_demand() -> Schema:
    """Return the schema of settings that no file of the package contains."""
    found: Schema = {}
    for path, setting in settings.ON_DEMAND.items():
        top, _, below = path.partition(".")
        limits = f" ({setting.limits.allowed})" if setting.limits else ""
        described = {"description": setting.help + limits}
        if below:
            node = found.setdefault(top, {"type": "object", "properties": {}})
            node |= {"additionalProperties": False}
            node["properties"][below] = described
        else:
            found[top] = described
    return found


def choices() -> dict[str, list[str]]:
    """Return the names of all choices by group, such as ``task/net``."""
    found: dict[str, list[str]] = {}
    for path in sorted(conf_dir().rglob("*.yaml")):
        group = path.relative_to(conf_dir()).parent.as_posix()
        if group != "." and not group.startswith("hydra"):
            found.setdefault(group, []).append(path.stem)
    return found


def _default(groups: dict[str, list[str]]) -> Schema:
    """Return the schema of an entry such as ``override /sampler: fmops``."""
    named = {
        rf"^((override|optional) )*/?{group}(@.*)?$": {
            "anyOf": [{"enum": names}, {"type": ["string", "null", "array"]}]
        }
        for group, names in groups.items()
    }
    return {"type": "object", "patternProperties": named}


def _group(name: str) -> Schema:
    """Return the schema of a group: the settings of all its choices."""
    found: Schema = {}
    for path in sorted((conf_dir() / name).glob("*.yaml")):
        _add(found, OmegaConf.to_container(OmegaConf.load(path)))
    for folder in sorted(path for path in (conf_dir() / name).iterdir() if path.is_dir()):
        if folder.with_suffix(".yaml").is_file():  # sampler/mops, whose files change mops.yaml
            for path in sorted(folder.glob("*.yaml")):
                _add(found, OmegaConf.to_container(OmegaConf.load(path)))
        else:
            found[folder.name] = _group(f"{name}/{folder.name}")
    return _node(found, name in OPEN)


def _add(found: Schema, node: Any) -> None:
    """Add the settings of a node with ``_target_`` and of the nodes below it."""
    target = node.get("_target_")
    try:
        parameters = signature(str(target), "") if target else {}
    except UserError:  # the package of an extra is not installed
        parameters = {}
    for key, parameter in parameters.items():
        if parameter.kind is not parameter.VAR_KEYWORD and not key.startswith("_"):
            _merge(found, key, _or_interpolation(_typed(parameter.annotation)))
    for key, value in node.items():
        if isinstance(value, dict):
            below: Schema = {}
            _add(below, value)
            found[key] = _node(below, False)
        elif not key.startswith("_") and key != "defaults":
            found.setdefault(key, {})


def _merge(found: Schema, key: str, own: Schema) -> None:
    """Let a setting have the types of all choices that have it."""
    earlier = found.get(key)
    if earlier and own and own != earlier:
        parts = [*earlier.get("anyOf", [earlier]), *own.get("anyOf", [own])]
        own = {"anyOf": [part for i, part in enumerate(parts) if part not in parts[:i]]}
    found[key] = own


def _node(properties: Schema, is_open: bool) -> Schema:
    """Return the schema of an object; a class of the user's own takes any settings."""
    own = {"_target_": {"type": "string"}, **properties}
    found: Schema = {"type": ["object", "null", "string"], "properties": own}
    if not is_open:
        known = ["defaults", "schedule", "_partial_", *own]
        found["anyOf"] = [{"required": ["_target_"]}, {"propertyNames": {"enum": known}}]
    return found


def _typed(annotation: Any) -> Schema:
    """Return the schema of an annotation; empty where any value may fit."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if annotation in PLAIN:
        return {"type": PLAIN[annotation]}
    if origin in (Union, types.UnionType):
        # typing takes Union[int, float] for Union[float, int], whichever was written first.
        parts = sorted((_typed(part) for part in inner), key=json.dumps)
        return {"anyOf": parts} if all(parts) else {}
    if origin is Literal:
        return {"enum": list(inner)}
    if origin in LISTS or annotation in LISTS:
        items = _typed(inner[0]) if inner else {}
        return {"type": "array", **({"items": _or_interpolation(items)} if items else {})}
    return {"type": "string"} if annotation is Path else {}


def _or_interpolation(own: Schema) -> Schema:
    if not own or own == {"type": "string"}:
        return own
    return {"anyOf": [*own.get("anyOf", [own]), INTERPOLATION]}
