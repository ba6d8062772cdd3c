"""Finding mistakes in a configuration before any heavy work.

Checked are names, types and run-level limits. The range of an argument is checked by its class.
"""

import math
import re
from inspect import Parameter
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import msgspec
from omegaconf import MISSING, DictConfig, OmegaConf

from mops_lightning.config import settings
from mops_lightning.config.build import build, signature, takes_keywords
from mops_lightning.config.shortened import UNLIMITED, has_step_limit
from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.tree import dotted

OPTIMIZERS = ("optimizer", "pretrain")
"""Nodes whose ``schedule`` is not an argument of the optimizer."""

TABLES = ("epochs", "augment", "pretrain")
"""Settings that contain settings but are not groups of choices."""

AUGMENTATION = "mops_lightning.data.loader.Augmentation"
"""The class behind each part of ``augment``."""

WORDS = {
    "int": "a whole number",
    "float": "a number",
    "bool": "true or false",
    "str": "a text",
    "array": "a list",
}
"""Msgspec's names of types in words, behind "must be"."""


def check(cfg: DictConfig) -> None:
    """Find mistakes in a configuration before any heavy work.

    Raises:
        UserError: an unknown key (the nearest known one is named), a value out of range, or a
            ``_target_`` that cannot be imported or does not take one of its arguments.
    """
    _check_top_level(cfg)
    # Resolved once: OmegaConf parses an interpolation each time it is read.
    plain: Any = OmegaConf.to_container(cfg, resolve=True)
    _check_corruption(plain["test_corruption"])
    _check_evaluation(plain)
    _check_epochs(plain["epochs"])
    _check_augmentation(plain["augment"])
    _check_number_of_points(plain)
    for name, setting in settings.declared().items():
        if setting.counts(plain["learn"]):
            _check_node(plain.get(name), name)
    _check_limits(plain)
    if plain["learn"] != "nothing":
        _check_length(plain["trainer"])


def _check_top_level(cfg: DictConfig) -> None:
    """Refuse unknown and removed settings, before any of them is read."""
    declared = settings.declared()
    for key in map(str, cfg):
        if key not in declared:
            raise UserError(f"{key}: no such setting.{did_you_mean(key, declared)}")
    for name, setting in declared.items():
        is_removed = name not in cfg or (cfg.get(name) is None and not setting.nullable)
        if is_removed:
            raise UserError(f"{name} cannot be removed. Choose another one with {name}=...")
        if setting.group or name in TABLES:
            _check_table(cfg.get(name), name)
    if not isinstance(cfg.task.get("net"), DictConfig):
        raise UserError("task.net cannot be removed. Choose another one with task/net=NAME.")
    if cfg.learn not in settings.LEARN:  # trainer.max_epochs is looked up by it
        raise refusal("learn", cfg.learn)


def _check_corruption(corruption: str | None) -> None:
    if corruption is None:
        return
    from mops_lightning.data import corruptions  # imports torch, which --help does without

    corruptions.parse(corruption)


def _check_epochs(epochs: dict[str, Any]) -> None:
    for key, number in epochs.items():
        if key not in settings.LEARN:
            raise UserError(f"epochs.{key}: no such setting.{did_you_mean(key, settings.LEARN)}")
        if number == MISSING:
            raise UserError(f"epochs.{key} must be set: try epochs.{key}=NUMBER.")


def _check_augmentation(augment: dict[str, Any]) -> None:
    for key, node in augment.items():
        if key not in ("task", "sampler") or not isinstance(node, dict | None):
            raise UserError(f"augment has settings of task and sampler, got {key}: {node!r}.")
        where = f"augment.{key}"
        described = {**(node or {}), "_target_": AUGMENTATION}
        _check_node(described, where)
        build(OmegaConf.create(described), where)  # the class checks its values


def _check_number_of_points(config: dict[str, Any]) -> None:
    """Refuse clouds of different sizes for a task net that makes clouds of one size."""
    is_open = config["dataset"].get("n_points", 0) is None
    if is_open and "n_points" in config["task"]["net"]:
        net = config["names"]["net"]
        raise UserError(
            f"dataset.n_points must be a number with task/net={net}: it makes clouds of one size."
        )


def _check_length(trainer: dict[str, Any]) -> None:
    """Refuse a training without an end that is known before it begins.

    Learning rate, temperature and recipe follow the share of the steps that are done.
    """
    epochs = trainer["max_epochs"]
    if epochs == UNLIMITED:
        if not has_step_limit(trainer):
            raise UserError(
                "trainer.max_epochs=-1 needs trainer.max_steps: the learning rate and the "
                "temperature depend on the length of the training. Add +trainer.max_steps=NUMBER; "
                "trainer.max_time may end the training earlier."
            )
        return
    if epochs < 1:
        raise UserError(
            "trainer.max_epochs must be a whole number of at least 1, or -1 with "
            f"trainer.max_steps, got {epochs}."
        )
    fewest = trainer.get("min_epochs") or 0
    if fewest > epochs:
        raise UserError(
            f"trainer.min_epochs must be at most trainer.max_epochs={epochs}, got {fewest}."
        )


def refusal(path: str, value: Any) -> UserError:
    """Return the error about a value that does not fit a setting's type or limits."""
    limits = settings.of(path).limits
    if limits is not None:
        return limits.refusal(path, value)
    hint = get_type_hints(settings.SCHEMA).get(path, Any)
    return UserError(f"{path} must be {misfit(value, hint)}, got {value!r}.")


def _check_table(value: Any, name: str) -> None:
    """Refuse a plain value where there must be settings, also for one callback or baseline."""
    if value is not None and not isinstance(value, DictConfig):
        raise UserError(f"{name} must be settings, got {value!r}. Write {name}.KEY=VALUE.")
    if value is None or name not in ("callbacks", "baselines"):
        return
    for key in value:
        if value[key] is not None and not isinstance(value[key], DictConfig):
            raise UserError(
                f"{name}.{key!s} must be null or settings with a class, got {value[key]!r}. "
                f"Give its class as {name}.{key!s}._target_=MODULE.CLASS."
            )


def _check_limits(config: dict[str, Any]) -> None:
    """Refuse values outside of limits, NaN, infinity and whole numbers beyond 64 bits."""
    values = dotted(config)
    for path in (*settings.declared(), *settings.INSIDE):
        limits = settings.limits(path)
        value = values.get(path, MISSING)
        if limits is None or value == MISSING:
            continue
        if not limits.fits(value):
            raise limits.refusal(path, value)
    for path, value in values.items():
        items = value if isinstance(value, list) else [value]
        for number in items:
            if not _is_usable(number):
                raise UserError(f"{path} must be finite and below 2**63, got {number!r:.30}.")


def _is_usable(value: Any) -> bool:
    """Return whether a number is finite and fits 64 bits; other values are usable."""
    if isinstance(value, int):
        return abs(value) < 2**63
    if isinstance(value, float):
        return math.isfinite(value)
    return True


def _check_evaluation(config: dict[str, Any]) -> None:
    learn = config["learn"]
    evaluate = config["evaluate"]
    if evaluate and learn not in ("nothing", "task"):
        raise UserError(
            f"evaluate: trains nothing, got learn={learn}. Leave learn out, or train "
            "without evaluate."
        )
    if not evaluate and config["weights"] == "run":
        raise UserError("weights=run means the run named by evaluate=RUN, which is not given.")
    if learn == "nothing" and config["ckpt_path"] is not None:
        raise UserError("ckpt_path resumes training; to test a trained run give evaluate=RUN.")


def _check_node(node: Any, where: str) -> None:
    """Compare every ``_target_`` below ``node`` with its constructor's signature."""
    if not isinstance(node, dict):
        return
    if node.get("_target_", "") in (None, MISSING):
        raise UserError(f"{where}._target_ must be set: give {where}._target_=MODULE.CLASS.")
    if "_target_" in node:
        _check_arguments(node, where)
    for key, child in node.items():
        _check_node(child, f"{where}.{key!s}")


def _check_arguments(node: dict[Any, Any], where: str) -> None:
    """Compare the settings of a node with the signature of its ``_target_``."""
    parameters = signature(str(node["_target_"]), where)
    takes_any = any(takes_keywords(parameter) for parameter in parameters.values())
    for key, value in node.items():
        name = str(key)
        path = f"{where}.{name}"
        if name == "schedule" and where in OPTIMIZERS:  # built separately
            if not isinstance(value, dict | None):
                raise UserError(f"{path} must be settings, got {value!r}.")
            continue
        is_known = name.startswith("_") or name in parameters or takes_any
        if not is_known:
            raise UserError(
                f"{where}: {node['_target_']} takes no setting {name!r}."
                f"{did_you_mean(name, parameters)}"
            )
        if value == MISSING:
            raise UserError(f"{path} must be set: try {path}=VALUE.")
        if name in parameters:
            _check_type(value, parameters[name].annotation, path)


def _check_type(value: Any, annotation: Any, path: str) -> None:
    """Refuse a value that does not fit the type of its argument; objects are built later."""
    if isinstance(value, dict) and "_target_" in value:
        return
    wanted = misfit(value, annotation)
    if wanted == "Callable" and path.endswith(".sampler"):  # of the stages of a net
        wanted = f"chosen by sampler@{path}=NAME"
    if wanted:
        raise UserError(f"{path} must be {wanted}, got {value!r}.")


def misfit(value: Any, annotation: Any) -> str | None:
    """Say what an annotation wants when a value does not fit it.

    Args:
        value: plain data: a number, a text, a truth value, None, a list or a dict.
        annotation: as written in the signature. One that msgspec does not know fits any value.

    Returns:
        Such as "a whole number or null"; None where the value fits. A wrong text of several fixed
        ones fits: the constructor names the nearest right one.
    """
    if annotation is Parameter.empty:
        return None
    try:
        msgspec.convert(value, _as_setting(annotation))
    except msgspec.ValidationError as error:
        return _in_words(str(error))
    except TypeError:  # msgspec does not know the annotation
        pass
    return None


def _as_setting(annotation: Any) -> Any:
    """Return an annotation without the types that no setting has: tensors and paths."""
    if get_origin(annotation) not in (Union, UnionType):
        return annotation
    kept = []
    for kind in get_args(annotation):
        if getattr(kind, "__name__", "") not in ("Tensor", "Path"):
            kept.append(kind)
    return Union[tuple(kept)]  # noqa: UP007


def _in_words(message: str) -> str | None:
    """Return what a message of msgspec expects, in words."""
    expected = re.match("Expected `([^`]+)`", message)
    if expected is None:
        return None
    kinds = expected[1].split(" | ")
    words = " or ".join(WORDS.get(kind, kind) for kind in kinds)
    is_about_item = "`$[" in message
    if is_about_item:
        return f"a list, each of it {words}"
    return words
