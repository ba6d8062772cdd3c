"""Finding mistakes in a configuration before any heavy work.

Checked are names, types and run-level limits. The range of an argument is checked by its class.
"""

import re
from inspect import Parameter
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import msgspec
from omegaconf import MISSING, DictConfig, OmegaConf

from mops_lightning.config import settings
from mops_lightning.config.build import build, signature
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
    declared = settings.declared()
    for key in map(str, cfg):
        if key not in declared:
            hint = did_you_mean(key, declared)
            raise UserError(f"{key}: no such setting.{hint}")
    for name, setting in declared.items():
        if name not in cfg or (cfg.get(name) is None and not setting.nullable):
            raise UserError(f"{name} cannot be removed. Choose another one with {name}=...")
        if setting.group or name in TABLES:
            _check_table(cfg.get(name), name)
    if not isinstance(cfg.task.get("net"), DictConfig):
        raise UserError("task.net cannot be removed. Choose another one with task/net=NAME.")
    if cfg.learn not in settings.LEARN:  # trainer.max_epochs is looked up by it
        raise refusal("learn", cfg.learn)
    # Resolved once: OmegaConf parses an interpolation each time it is read.
    plain: Any = OmegaConf.to_container(cfg, resolve=True)
    if plain["test_corruption"] is not None:
        from mops_lightning.data import corruptions  # imports torch, which --help does without

        corruptions.parse(plain["test_corruption"])
    _check_evaluation(plain)
    for key, number in plain["epochs"].items():
        if key not in settings.LEARN:
            raise UserError(f"epochs.{key}: no such setting.{did_you_mean(key, settings.LEARN)}")
        if number == MISSING:
            raise UserError(f"epochs.{key} must be set: try epochs.{key}=NUMBER.")
    for key, node in plain["augment"].items():
        if key not in ("task", "sampler") or not isinstance(node, dict | None):
            raise UserError(f"augment has settings of task and sampler, got {key}: {node!r}.")
        described = {**(node or {}), "_target_": AUGMENTATION}
        _check_node(described, f"augment.{key}")
        build(OmegaConf.create(described), f"augment.{key}")  # the class checks its values
    for name, setting in declared.items():
        if setting.counts(plain["learn"]):
            _check_node(plain.get(name), name)
    _check_limits(plain)
    if cfg.learn != "nothing":
        _check_length(plain["trainer"])


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
        limits, value = settings.of(path).limits, values.get(path, MISSING)
        if limits and value != MISSING and not limits.fits(value):
            raise limits.refusal(path, value)
    for path, value in values.items():
        for number in value if isinstance(value, list) else [value]:
            limit = 2**63 if isinstance(number, int) else float("inf")
            if isinstance(number, int | float) and not abs(number) < limit:  # NaN neither
                raise UserError(f"{path} must be finite and below 2**63, got {number!r:.30}.")


def _check_evaluation(config: dict[str, Any]) -> None:
    learn, evaluate = config["learn"], config["evaluate"]
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
        parameters = signature(str(node["_target_"]), where)
        takes_any = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
        for key in node:
            name = str(key)
            if name == "schedule" and where in OPTIMIZERS:
                if not isinstance(node[key], dict | None):
                    raise UserError(f"{where}.schedule must be settings, got {node[key]!r}.")
                continue  # built separately
            if not name.startswith("_") and name not in parameters and not takes_any:
                raise UserError(
                    f"{where}: {node['_target_']} takes no setting {name!r}."
                    f"{did_you_mean(name, parameters)}"
                )
            if node[key] == MISSING:
                raise UserError(f"{where}.{name} must be set: try {where}.{name}=VALUE.")
            built = isinstance(node[key], dict) and "_target_" in node[key]
            if name in parameters and not built:
                wanted = misfit(node[key], parameters[name].annotation)
                if wanted == "Callable" and name == "sampler":  # of the stages of a net
                    wanted = f"chosen by sampler@{where}.sampler=NAME"
                if wanted:
                    raise UserError(f"{where}.{name} must be {wanted}, got {node[key]!r}.")
    for key in node:
        _check_node(node[key], f"{where}.{key!s}")


def misfit(value: Any, annotation: Any) -> str | None:
    """Say what an annotation wants when a value does not fit it.

    Args:
        value: plain data: a number, a text, a truth value, None, a list or a dict.
        annotation: as written in the signature. One that msgspec does not know fits any value.

    Returns:
        Such as "a whole number or null"; None where the value fits. A wrong text of several fixed
        ones fits: the constructor names the nearest right one.
    """
    if get_origin(annotation) in (Union, UnionType):  # no setting is a tensor or a Path
        parts = [(one, getattr(one, "__name__", "")) for one in get_args(annotation)]
        plain = tuple(one for one, name in parts if name not in ("Tensor", "Path"))
        annotation = Union[plain]  # noqa: UP007
    if annotation is Parameter.empty:
        return None
    try:
        msgspec.convert(value, annotation)
    except msgspec.ValidationError as error:
        if expected := re.match("Expected `([^`]+)`", str(error)):
            words = " or ".join(WORDS.get(word, word) for word in expected[1].split(" | "))
            return f"a list, each of it {words}" if "`$[" in str(error) else words
    except TypeError:
        pass
    return None
