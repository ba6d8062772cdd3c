"""Errors of Hydra, OmegaConf and YAML in words: the setting, and the nearest known one."""

import argparse
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationResolutionError, ValidationError
from yaml import MarkedYAMLError  # type: ignore[import-untyped]

from mops_lightning.config import settings
from mops_lightning.config.build import signature
from mops_lightning.config.by_hydra import composed
from mops_lightning.config.groups import choice_groups, conf_dir, is_offered, sweeps_dir
from mops_lightning.config.overrides import key as key_of
from mops_lightning.config.validate import AUGMENTATION, refusal
from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.tree import dotted

SET_IN_FULL = ("task", "dataset", "sampler")
"""Groups whose files set every argument of the package's classes that a user may set."""
AUGMENTED = ("augment.task", "augment.sampler")
"""Settings of the class ``AUGMENTATION``, which may be null."""

NO_OVERRIDE = re.compile(r"Could not override '([^']*)")
NOT_IN_STRUCT = re.compile(r"is not in struct\s+full_key: (\S+)")
UNKNOWN_IN_FILE = re.compile(r"In '(.+)': ConfigKeyError .*\nKey '(\w+)' not in 'Run")
UNREAD = re.compile(r"Lexer\w+: (.*)")
REMOVED = re.compile(r"Key '(\w+)' not in 'RunSettings'")
"""Messages of Hydra and OmegaConf about mistakes, with the names in them."""


def explain(error: BaseException, arguments: Sequence[str]) -> str:
    """Turn an error into one line that names the setting and the nearest known one.

    Args:
        error: raised while a configuration was composed.
        arguments: the arguments of the command line, or the overrides.
    """
    if isinstance(error, UnicodeDecodeError):
        return f"a file of settings is not in UTF-8: {error.object[:30]!r}: {error.reason}."
    if isinstance(error, MarkedYAMLError) and error.problem_mark is not None:
        mark = error.problem_mark
        return f"{mark.name}, line {mark.line + 1}: not valid YAML: {error.problem}."
    texts = []
    for cause in _causes(error):
        line = _from_kind(cause, arguments)
        if line:
            return line
        texts.append(str(cause).strip())
    for text in texts:
        line = _from_words(text, texts, arguments)
        if line:
            return line
    return _without_notes(texts)


def _causes(error: BaseException) -> Iterator[BaseException]:
    """Yield an error and the errors behind it."""
    cause: BaseException | None = error
    while cause is not None:
        yield cause
        cause = cause.__cause__


def _from_kind(cause: BaseException, arguments: Sequence[str]) -> str | None:
    """Return one line about an error whose class and attributes say what is wrong."""
    from hydra.errors import MissingConfigException

    if isinstance(cause, ValidationError) and cause.full_key:
        return str(refusal(cause.full_key, cause.value))
    if isinstance(cause, InterpolationResolutionError) and _is_setting(cause.full_key):
        return f"{cause.full_key}: {str(cause).splitlines()[0]}."
    if isinstance(cause, MissingConfigException) and cause.missing_cfg_file:
        if not cause.options:
            return _no_such_file(cause.missing_cfg_file)
        return _no_such_choice(cause.missing_cfg_file, cause.options, arguments)
    return None


def _no_such_file(name: str) -> str:
    """Name the sweeps nearest to a file of ``--config-name`` that does not exist."""
    sweeps = [path.stem for path in sweeps_dir().glob("*.yaml")]
    hint = did_you_mean(name, sweeps)
    return f"--config-name {name}: no such file in --config-dir, conf or sweeps.{hint}"


def _no_such_choice(file: str, options: Sequence[str], arguments: Sequence[str]) -> str:
    """Name the choices nearest to one that no file describes.

    Args:
        file: the file that Hydra did not find, such as ``sampler/mop``.
        options: the choices of the group.
        arguments: the overrides.
    """
    group, _, choice = file.rpartition("/")
    key = group
    for argument in arguments:
        asked = key_of(argument)
        if argument.endswith(f"={choice}") and asked.partition("@")[0] == group:
            key = asked
            break
    return f"{key}={choice}: no such choice.{did_you_mean(choice, options)}"


def _from_words(text: str, texts: Sequence[str], arguments: Sequence[str]) -> str | None:
    """Return one line about an error of which only the message says what is wrong.

    Args:
        text: the message of the error.
        texts: the messages of all its causes.
        arguments: the overrides.
    """
    refused = NO_OVERRIDE.search(text)
    if refused:
        inside = NOT_IN_STRUCT.search("\n".join(texts))
        named = inside or refused
        return no_such_setting(named.group(1), arguments)
    unknown = UNKNOWN_IN_FILE.search(text)
    if unknown:
        file, name = unknown.groups()
        return f"{file}.yaml: {name}: no such setting.{did_you_mean(name, settings.declared())}"
    unread = UNREAD.match(text)
    if unread:
        return f"{unread.group(1).strip()!r} is not a setting. Settings are KEY=VALUE."
    removed = REMOVED.search(text)
    if removed:
        return f"{removed.group(1)} cannot be removed."
    return None


def _without_notes(texts: Sequence[str]) -> str:
    """Return Hydra's and OmegaConf's own messages in one line, without notes for developers."""
    lines = []
    for text in texts:
        for line in text.splitlines():
            is_note = line.startswith(" ")
            if line.strip() and not is_note:
                lines.append(line.strip())
    return " ".join(dict.fromkeys(lines))


def _is_setting(path: str | None) -> bool:
    """Return whether a path is one of a user's settings; Hydra's own are made from these."""
    return bool(path) and not str(path).startswith("hydra.")


def no_such_setting(key: str, arguments: Sequence[str]) -> str:
    """Name the nearest group or setting, or say how to set an argument that no YAML file sets.

    Args:
        key: the unknown key.
        arguments: the arguments of the command line, or the overrides.
    """
    groups = choice_groups()
    if key in groups:
        return f"{key}: its files are chosen by other groups. --cfg job shows what they set."
    if key.startswith("sampler@"):
        hint = "The stages of hierarchical nets have one."
        if "@baselines." in key:
            hint = f"Write +{key}=..."
        return f"{key}: no sampler is chosen there. {hint}"
    if "/" in key or "@" in key:
        offered = [group for group in groups if is_offered(group)]
        return f"{key}: no such group of choices.{did_you_mean(key, offered)}"
    cfg = _composed(groups, arguments)
    target = _taken_by(key, cfg)
    if target:
        return f"{key}: {target} accepts it, but no file sets it. Write +{key}=..."
    choices = _choices_with(key, groups)
    if choices:
        return f"{key}: no such setting here. It belongs to {' and '.join(choices)}."
    known = set(settings.declared())
    for path in dotted(OmegaConf.to_container(cfg, resolve=False)):
        if "._" not in path:
            known.add(path)
    known.discard(key)
    return f"{key}: no such setting.{did_you_mean(key, known)} --cfg job shows all of them."


def _taken_by(key: str, cfg: DictConfig) -> str | None:
    """Return the class whose constructor takes an argument that no file sets, if there is one."""
    node, _, name = key.rpartition(".")
    target = OmegaConf.select(cfg, f"{node}._target_")
    if node in AUGMENTED:
        target = AUGMENTATION
    if not target or _is_set_in_full(node, target):
        return None
    with suppress(UserError):  # the class of a user's own file may not be importable
        if name in signature(str(target), node):
            return str(target)
    return None


def _is_set_in_full(node: str, target: str) -> bool:
    """Return whether the files of a node set every argument: the class, and torch, can wait."""
    is_of_package = str(target).startswith("mops_lightning.")
    return is_of_package and node.partition(".")[0] in SET_IN_FULL


def _choices_with(key: str, groups: Sequence[str]) -> list[str]:
    """Return the choices of the setting's group whose files set it, as overrides."""
    node, _, name = key.rpartition(".")
    group = node.rpartition(".")[2]  # of task.net.sampler, too
    if group not in groups:
        return []
    package = f"@{node}" if "." in node else ""
    choices = []
    for file in sorted(conf_dir().joinpath(group).glob("*.yaml")):
        content = OmegaConf.load(file)
        if content and name in content:
            choices.append(f"{group}{package}={file.stem}")
    return choices


def _composed(groups: Sequence[str], arguments: Sequence[str]) -> DictConfig:
    """Compose the groups that the command line chooses, without its other settings."""
    choices = []
    for argument in arguments:
        group = key_of(argument).partition("@")[0]
        if group in groups:
            choices.append(argument)
    own = _folder_of_ones_own(arguments)
    if own is not None:
        choices.append(f"hydra.searchpath=['file://{own.absolute()}']")
    try:
        return composed(choices)
    except Exception:  # the mistake may be among them
        return composed([])


def _folder_of_ones_own(arguments: Sequence[str]) -> Path | None:
    """Return the folder of ``--config-dir``, if the arguments have this flag."""
    flags = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    flags.add_argument("--config-dir", "-cd", dest="folder", type=Path)
    folder: Path | None = flags.parse_known_args(arguments)[0].folder
    return folder
