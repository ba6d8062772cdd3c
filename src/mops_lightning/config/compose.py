"""Composing a configuration from the folder ``conf/``, and the resolvers that its files use.

A mistake becomes one line with the setting and the nearest known one.
"""

import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import (
    InterpolationResolutionError,
    OmegaConfBaseException,
    ValidationError,
)
from yaml import MarkedYAMLError, YAMLError  # type: ignore[import-untyped]

from mops_lightning.config import settings
from mops_lightning.config.build import signature
from mops_lightning.config.given import check_overrides
from mops_lightning.config.groups import choice_groups, conf_dir, is_offered, sweeps_dir
from mops_lightning.config.help import run_level_keys, selectable_groups
from mops_lightning.config.overrides import key as key_of
from mops_lightning.config.overrides import with_own_classes
from mops_lightning.config.validate import AUGMENTATION, refusal
from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.tree import dotted

NAMED = {name: name for name in ("task", "dataset", "sampler", "recipe")}
NAMED |= {"net": "task/net", "stages": "sampler@task.net.sampler"}
"""The groups whose choices are in ``names``, by name."""
OWN = "own"
"""The choice of a group for a class of the user's own."""
SET_IN_FULL = ("task", "dataset", "sampler")
"""Groups whose files set every argument of the package's classes that a user may set."""
AUGMENTED = ("augment.task", "augment.sampler")
"""Settings of the class ``AUGMENTATION``, which may be null."""


def composed(overrides: list[str]) -> DictConfig:
    """Compose a configuration; errors are raised by Hydra, OmegaConf and YAML."""
    from hydra import compose as compose_by_hydra
    from hydra import initialize_config_dir
    from hydra.core.hydra_config import HydraConfig

    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        cfg = compose_by_hydra("config", overrides=overrides, return_hydra_config=True)
    HydraConfig.instance().set_config(cfg)
    plain = OmegaConf.masked_copy(cfg, [str(key) for key in cfg if key != "hydra"])
    # Names come from Hydra's choices; resolved here they outlive the global HydraConfig.
    plain.names = OmegaConf.to_container(cfg.names, resolve=True)
    return plain


def compose(overrides: list[str] | None = None) -> DictConfig:
    """Compose a configuration as the command line does, for notebooks and tests.

    Args:
        overrides: such as ``["m=64", "sampler=fps"]``.

    Raises:
        UserError: an unknown setting or choice, or a value of another type than the setting's.
    """
    from hydra.errors import HydraException

    given = with_own_classes(overrides or [])
    check_overrides(given)
    try:
        return composed(given)
    except (HydraException, OmegaConfBaseException, YAMLError, UnicodeDecodeError) as error:
        raise UserError(explain(error, given)) from None


def explain(error: BaseException, arguments: Sequence[str]) -> str:
    """Turn an error into one line that names the setting and the nearest known one.

    Args:
        error: raised while a configuration was composed.
        arguments: of the command line, or the overrides.
    """
    from hydra.errors import MissingConfigException

    if isinstance(error, UnicodeDecodeError):
        return f"a file of settings is not in UTF-8: {error.object[:30]!r}: {error.reason}."
    if isinstance(error, MarkedYAMLError) and error.problem_mark is not None:
        mark = error.problem_mark
        return f"{mark.name}, line {mark.line + 1}: not valid YAML: {error.problem}."
    texts = []
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, ValidationError) and cause.full_key:
            return str(refusal(cause.full_key, cause.value))
        if isinstance(cause, InterpolationResolutionError) and _is_setting(cause.full_key):
            return f"{cause.full_key}: {str(cause).splitlines()[0]}."
        if isinstance(cause, MissingConfigException) and cause.missing_cfg_file:
            if not cause.options:
                name = cause.missing_cfg_file
                hint = did_you_mean(name, [path.stem for path in sweeps_dir().glob("*.yaml")])
                return f"--config-name {name}: no such file in --config-dir, conf or sweeps.{hint}"
            group, _, choice = cause.missing_cfg_file.rpartition("/")
            asked = [key_of(one) for one in arguments if one.endswith(f"={choice}")]
            key = next((one for one in asked if one.partition("@")[0] == group), group)
            return f"{key}={choice}: no such choice.{did_you_mean(choice, cause.options or ())}"
        texts.append(str(cause).strip())
        cause = cause.__cause__
    for text in texts:
        if "Could not override '" in text:
            key = text.split("Could not override '")[1].split("'")[0]
            inside = re.search(r"is not in struct\s+full_key: (\S+)", "\n".join(texts))
            return _no_such_setting(inside.group(1) if inside else key, arguments)
        if unknown := re.search(r"In '(.+)': ConfigKeyError .*\nKey '(\w+)' not in 'Run", text):
            hint = did_you_mean(unknown.group(2), settings.declared())
            return f"{unknown.group(1)}.yaml: {unknown.group(2)}: no such setting.{hint}"
        if unread := re.match(r"Lexer\w+: (.*)", text):
            return f"{unread.group(1).strip()!r} is not a setting. Settings are KEY=VALUE."
        if removed := re.search(r"Key '(\w+)' not in 'RunSettings'", text):
            return f"{removed.group(1)} cannot be removed."
    # Hydra's and OmegaConf's own messages, without their notes for developers.
    lines = [line for text in texts for line in text.splitlines() if line.strip()]
    return " ".join(dict.fromkeys(line.strip() for line in lines if line[0] != " "))


def _is_setting(path: str | None) -> bool:
    """Return whether a path is one of a user's settings; Hydra's own are made from these."""
    return bool(path) and not str(path).startswith("hydra.")


def _no_such_setting(key: str, arguments: Sequence[str]) -> str:
    """Name the nearest group or setting, or say how to set an argument that no YAML file sets."""
    groups = choice_groups()
    if key in groups:
        return f"{key}: its files are chosen by other groups. --cfg job shows what they set."
    if key.startswith("sampler@"):
        hint = "The stages of hierarchical nets have one."
        hint = f"Write +{key}=..." if "@baselines." in key else hint
        return f"{key}: no sampler is chosen there. {hint}"
    if "/" in key or "@" in key:
        offered = [group for group in groups if is_offered(group)]
        return f"{key}: no such group of choices.{did_you_mean(key, offered)}"
    cfg = _composed(groups, arguments)
    node, _, name = key.rpartition(".")
    target = AUGMENTATION if node in AUGMENTED else OmegaConf.select(cfg, f"{node}._target_")
    if _is_set_in_full(node, target):
        target = None
    with suppress(UserError):  # the class of a user's own file may not be importable
        if target and name in signature(str(target), node):
            return f"{key}: {target} accepts it, but no file sets it. Write +{key}=..."
    group = node.rpartition(".")[2]  # of task.net.sampler, too
    files = sorted(conf_dir().joinpath(group).glob("*.yaml")) if group in groups else []
    at = f"@{node}" if "." in node else ""
    choices = [f"{group}{at}={one.stem}" for one in files if name in (OmegaConf.load(one) or {})]
    if choices:
        return f"{key}: no such setting here. It belongs to {' and '.join(choices)}."
    leaves = dotted(OmegaConf.to_container(cfg, resolve=False))
    known = {*settings.declared(), *(one for one in leaves if "._" not in one)} - {key}
    return f"{key}: no such setting.{did_you_mean(key, known)} --cfg job shows all of them."


def _is_set_in_full(node: str, target: str | None) -> bool:
    """Return whether the files of a node set every argument: the class, and torch, can wait."""
    is_of_package = str(target).startswith("mops_lightning.")
    return is_of_package and node.partition(".")[0] in SET_IN_FULL


def _composed(groups: Sequence[str], arguments: Sequence[str]) -> DictConfig:
    """Compose the groups that the command line chooses, without its other settings."""
    try:
        return composed([part for part in arguments if key_of(part).partition("@")[0] in groups])
    except Exception:  # the mistake may be among them
        return composed([])


def group_choices() -> DictConfig:
    """Return ``names``: the chosen task, task net, sampler of its stages, data set, ...."""
    from hydra.core.hydra_config import HydraConfig

    choices = HydraConfig.get().runtime.choices
    names = {name: choices.get(group) for name, group in NAMED.items()}
    if not names["stages"]:
        del names["stages"]  # most nets have none
    return OmegaConf.create(names)  # a node, so that interpolations find the names below it


def run_label(_root_: DictConfig) -> str:
    """Return the label of a run's folder: the net that it trains, or the sampler and its size."""
    names = _root_.names
    if _root_.learn == "task":
        return str(names.net)
    if _root_.evaluate:  # the size is in the run's record
        return f"{sampler_label(_root_)}-evaluated"
    size = _root_.sampler.get("m_max", _root_.m)
    anchored = "-anchored" if _root_.sampler.get("anchors") else ""
    joint = "-joint" if _root_.learn == "joint" else ""
    return f"{sampler_label(_root_)}{anchored}-m{size}{joint}"


def sampler_label(_root_: DictConfig) -> str:
    """Return the name of the sampler: its choice, or the class of a sampler of the user's own."""
    name = str(_root_.names.sampler)
    if name != OWN:
        return name
    return str(_root_.sampler.get("_target_")).rpartition(".")[2]


def tested_label(_root_: DictConfig) -> str:
    """Return the label of a test's folder: the run or model that it tests, else the sampler."""
    if not _root_.evaluate:
        return sampler_label(_root_)
    parts = [part for part in Path(_root_.evaluate).parts if part not in ("/", ".", "..", "~")]
    return "-".join(parts[-2:])  # of a cell of a sweep: the sweep and the cell


RESOLVERS = (
    group_choices,
    run_label,
    sampler_label,
    tested_label,
    run_level_keys,
    selectable_groups,
    min,
)

settings.register()
for resolver in RESOLVERS:
    OmegaConf.register_new_resolver(resolver.__name__, resolver, replace=True)
