"""The folder ``conf/`` and its groups of choices, such as ``task/net``."""

import re
from functools import cache
from pathlib import Path

from mops_lightning.config import settings

PRESETS = ("experiment", "debug")
"""Groups of presets, which are no settings themselves."""

KEY = re.compile(r"(\w+)['\"]?\s*:")
"""A key in a YAML file; also some words in comments, which does no harm."""


def conf_dir() -> Path:
    """Return the folder with the Hydra groups."""
    return _top() / "conf"


def sweeps_dir() -> Path:
    """Return the folder with the sweeps, each by ``--config-name``."""
    return _top() / "sweeps"


def _top() -> Path:
    """Return the folder of both: the package in the wheel, or the top of a checkout."""
    package = Path(__file__).resolve().parents[1]
    if (package / "conf").is_dir():
        return package
    return package.parents[1]


def choice_groups() -> list[str]:
    """List the groups of choices, such as ``task/net``."""
    root = conf_dir()
    folders = [path for path in root.rglob("*") if path.is_dir()]
    groups = [folder.relative_to(root).as_posix() for folder in folders]
    return [group for group in groups if not group.startswith("hydra")]


def is_offered(group: str) -> bool:
    """Return whether users choose from a group; of some, other choices choose the file."""
    top = group.partition("/")[0]
    is_named = top in settings.declared() or top in PRESETS
    return is_named and not (conf_dir() / f"{group}.yaml").is_file()


def has_choice(group: str, name: str) -> bool:
    """Return whether a file of ``conf/`` describes the choice ``name`` of a group."""
    return (conf_dir() / group / f"{name}.yaml").is_file()


@cache
def keys_of_files() -> frozenset[str]:
    """Return all keys, at any depth, that the files of ``conf/`` set."""
    keys: set[str] = set()
    for path in conf_dir().rglob("*.yaml"):
        keys.update(KEY.findall(path.read_text(encoding="utf-8")))
    return frozenset(keys)
