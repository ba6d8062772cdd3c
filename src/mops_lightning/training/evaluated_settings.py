"""The settings of an evaluation and those of the run that it tests."""

import re
from copy import deepcopy
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf, open_dict

from mops_lightning.config import overrides, settings
from mops_lightning.config.build import signature
from mops_lightning.config.declaration import Affects
from mops_lightning.config.validate import check
from mops_lightning.errors import UserError
from mops_lightning.records.run_record import RunRecord
from mops_lightning.training.replay import KEY, OF_RUN, names_code, place, trained_run
from mops_lightning.zoo import weights

SHARED = re.compile(r"\$\{\w+\}")
"""A setting that follows one of the command line, such as ``sampler.m`` follows ``m``."""


def as_trained(cfg: DictConfig, given: list[str] | None) -> DictConfig:
    """Return the configuration of an evaluation with its run's values of the sampler's settings.

    The defaults may have changed since. Only plain values are taken from a record, as from its
    overrides. What is given explicitly stays, for ``load`` to judge.

    Args:
        cfg: a composed configuration.
        given: the overrides it was composed from; None if all settings count as given.

    Raises:
        UserError: ``cfg.evaluate`` is not a completed run that trained something, or a value in
            its record or in ``cfg`` is wrong.
    """
    whole = any(argument.lstrip("+").startswith("sampler={") for argument in given or [])
    if given is None or whole or not cfg.evaluate or cfg.learn == "task":
        return cfg
    there = trained_run(cfg.evaluate).config
    _same_group("sampler", cfg.names.sampler, there, cfg.evaluate)
    here: Any = OmegaConf.to_container(cfg.sampler, resolve=True)
    raw: Any = OmegaConf.to_container(cfg.sampler, resolve=False)
    keys = {overrides.key(argument) for argument in given}
    changed = {
        key: old
        for key, (old, _) in _differences(here, there["sampler"]).items()
        if f"sampler.{key}" not in keys and not SHARED.fullmatch(str(raw.get(key)))
    }
    plain = {key: old for key, old in changed.items() if not names_code({key: old})}
    if not plain:
        return cfg
    check(cfg)  # the user's own mistakes first
    replaced = deepcopy(cfg)
    with open_dict(replaced.sampler):
        replaced.sampler.update(plain)
    try:
        check(replaced)
    except UserError as error:
        raise UserError(f"{KEY}: the record of {cfg.evaluate}: {error}") from None
    return replaced


def same_settings(cfg: DictConfig, record: RunRecord, run: str, task: torch.nn.Module) -> None:
    """Reject settings with which a run's nets cannot be tested.

    Args:
        cfg: the configuration of the evaluation.
        record: the run's.
        run: what the user calls it.
        task: the task of the evaluation.

    Raises:
        UserError: a setting differs from the run's.
    """
    there = record.config
    here: Any = OmegaConf.to_container(cfg, resolve=True)
    if (cfg.learn == "task") != (there["learn"] == "task"):
        raise UserError(
            f"{KEY}: {run} was made with learn={there['learn']}; leave learn out. To test a "
            "sampler with this task net, evaluate the sampler's run with "
            f"weights={weights.of_run(place(run))}."
        )
    if cfg.learn == "task" and cfg.weights != OF_RUN:
        raise UserError(f"{KEY}: {run} trained a task net; leave weights out.")
    for group in ("task",) if cfg.learn == "task" else ("task", "sampler"):
        _same_group(group, here["names"][group], there, run)
    weightless = not any(True for _ in task.parameters())
    if here["names"]["net"] != there["names"]["net"] and cfg.weights == OF_RUN and not weightless:
        raise UserError(
            f"{KEY}: the task net of {run} is {there['names']['net']}; for "
            f"task/net={here['names']['net']} also give its weights: weights=auto or weights=FILE."
        )
    if cfg.learn != "task":
        _same_sampler(here["sampler"], there["sampler"], run)


def _same_group(group: str, new: str, there: dict[str, Any], run: str) -> None:
    old = there["names"][group]
    if old != new:
        raise UserError(
            f"{KEY}: {run} was trained with {group}={old}, got {group}={new}. "
            f"Leave {group} out, or give a run with {group}={new}."
        )


def _same_sampler(here: dict[str, Any], there: dict[str, Any], run: str) -> None:
    for key, (old, new) in _differences(here, there).items():
        hint = " For other sizes of a flexible sampler give sizes=[...]." if key == "m" else ""
        raise UserError(
            f"{KEY}: sampler.{key} must be {old}, as in {run}, got {new}. "
            f"Leave it out, or train a sampler with it.{hint}"
        )


def _differences(here: dict[str, Any], there: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Return the settings of the training in which two samplers differ: old and new value.

    Records lack settings that are newer than they: those have the constructor's default.
    """
    defaults = {
        key: list(one.default) if isinstance(one.default, tuple) else one.default
        for key, one in signature(str(here["_target_"]), "sampler").items()
    }
    pairs = {
        key: tuple(node.get(key, defaults.get(key)) for node in (there, here))
        for key in sorted({*there, *here})
        if Affects.TRAINING in settings.of(f"sampler.{key}").affects
    }
    return {key: (old, new) for key, (old, new) in pairs.items() if old != new}
