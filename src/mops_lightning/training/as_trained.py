"""The settings of an evaluation: those of the trained run, then the user's."""

from copy import deepcopy
from inspect import Parameter
from typing import Any

from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from mops_lightning.config import overrides, settings
from mops_lightning.config.build import signature
from mops_lightning.config.validate import check
from mops_lightning.errors import UserError
from mops_lightning.records.run_record import RunRecord
from mops_lightning.training.evaluation import (
    EVALUATE,
    PLAIN_NAME,
    TrainedRun,
    is_repeated,
    is_special,
)
from mops_lightning.tree import dotted


def as_trained(cfg: DictConfig, trained: TrainedRun, arguments: list[str]) -> DictConfig:
    """Return the checked configuration of an evaluation: the run's settings, then the user's.

    An interpolation that resolves to the run's value is kept, so that ``sampler.seed`` follows the
    ``seed`` that a user gives.

    Args:
        cfg: composed from the run's groups.
        trained: the run.
        arguments: the overrides it was composed from.

    Raises:
        UserError: a value in the record or in ``cfg`` is wrong, or not accepted from a record.
    """
    chosen = trained.choices()
    changed = [overrides.path(argument) for argument in arguments if argument not in chosen]
    _check_special(trained, changed)
    try:
        merged = _recorded(cfg, trained)
        sampler = _plain(merged.sampler)
        with open_dict(merged):
            for path in changed:
                _restore(merged, cfg, path)
        check(merged)
    except (UserError, OmegaConfBaseException) as error:
        text = str(error).splitlines()[0]
        is_about_change = text.startswith(tuple(changed))
        if is_about_change:
            raise
        whole = f"{EVALUATE}: the record of {trained.name}: {text}"
        raise UserError(whole) from None
    if not trained.trained_task_net:
        _check_sampler(sampler, _plain(merged.sampler), trained.name)
    return merged


def lost_baselines(cfg: DictConfig, trained: TrainedRun, arguments: list[str]) -> list[str]:
    """Return the baselines of a run that its evaluation does not test, though nobody removed them.

    Those that an experiment's file had added name code, and none is taken from a record.

    Args:
        cfg: the settings of the evaluation, from ``as_trained``.
        trained: the run.
        arguments: the overrides of the evaluation.
    """
    if trained.trained_task_net or any(_is_of_baselines(argument) for argument in arguments):
        return []
    known = trained.record.config.get("baselines") or {}
    tested = cfg.baselines or {}
    return [name for name, sampler in known.items() if sampler and name not in tested]


def _is_of_baselines(argument: str) -> bool:
    """Return whether an override changes the baselines."""
    return overrides.path(argument).partition(".")[0] == "baselines"


def _check_special(trained: TrainedRun, changed: list[str]) -> None:
    """Refuse a record whose user named a class, unless the user of this evaluation names one.

    Raises:
        UserError: there is one.
    """
    for argument in trained.record.overrides:
        path = overrides.path(argument)
        if is_special(path) and is_repeated(path) and path not in changed:
            raise trained.not_accepted(path)


def _check_sampler(recorded: dict[str, Any], present: dict[str, Any], name: str) -> None:
    """Refuse settings of the sampler's training that differ from the run's.

    Args:
        recorded: the sampler's settings in the run.
        present: those of the evaluation.
        name: name of the run, for the error.

    Raises:
        UserError: a setting differs.
    """
    for key in sorted({*recorded, *present}):
        path = f"sampler.{key}"
        used = recorded.get(key)
        given = present.get(key)
        if used == given or not settings.of(path).affects_training:
            continue
        hint = ""
        if key == "m":
            hint = " For other sizes of a flexible sampler give sizes=[...]."
        raise UserError(
            f"{EVALUATE}: {path} must be {used}, as in {name}, got {given}. "
            f"Leave it out, or train a sampler with it.{hint}"
        )


def _plain(node: DictConfig) -> Any:
    return OmegaConf.to_container(node, resolve=True)


def _recorded(cfg: DictConfig, trained: TrainedRun) -> DictConfig:
    """Return a configuration with the run's values of all settings that an evaluation repeats.

    A setting that no longer exists is left out, unless the run's user had given it.
    """
    recorded = _leaves(trained.record.config)
    present = _leaves(OmegaConf.to_container(cfg, resolve=False))
    merged = deepcopy(cfg)
    with open_dict(merged):
        _drop_new_baselines(merged, trained.record)
        _check_trusted(recorded, trained)
        values = {}
        resolved = {}
        for path, value in recorded.items():
            if _is_interpolation(present.get(path)):
                resolved[path] = value
            else:
                values[path] = value
        _take_values(merged, cfg, values, trained.record)
        _take_defaults(merged, _newer_than_run(present, recorded))
        _take_other_results(merged, resolved)
    return merged


def _is_interpolation(value: Any) -> bool:
    return "${" in str(value)


def _newer_than_run(present: dict[str, Any], recorded: dict[str, Any]) -> list[str]:
    """Return the settings with a value of their own that the run's version did not have."""
    newer = []
    for path, value in present.items():
        if path not in recorded and not _is_interpolation(value):
            newer.append(path)
    return newer


def _drop_new_baselines(merged: DictConfig, record: RunRecord) -> None:
    """Remove the baselines that the run did not have."""
    known = record.config.get("baselines") or {}
    for name in list(merged.baselines or ()):
        if name not in known:
            del merged.baselines[name]


def _check_trusted(recorded: dict[str, Any], trained: TrainedRun) -> None:
    """Refuse recorded settings that name code.

    Raises:
        UserError: there is one.
    """
    for path, value in recorded.items():
        names = path.split(".")
        has_plain_names = all(PLAIN_NAME.fullmatch(name) for name in names)
        if not has_plain_names or _names_code(value):
            raise trained.not_accepted(path)


def _take_values(
    merged: DictConfig, cfg: DictConfig, recorded: dict[str, Any], record: RunRecord
) -> None:
    """Set the recorded values of settings that exist, or that the run's user had given."""
    given = {overrides.path(argument) for argument in record.overrides}
    for path, value in recorded.items():
        node, name = _node_of(cfg, path)
        if path in given or name in node or name in _parameters(node, path):
            OmegaConf.update(merged, path, value, merge=False)


def _take_defaults(merged: DictConfig, paths: list[str]) -> None:
    """Set settings to the defaults of their classes."""
    for path in paths:
        node, name = _node_of(merged, path)
        parameter = _parameters(node, path).get(name)
        if parameter is not None and parameter.default is not parameter.empty:
            OmegaConf.update(merged, path, parameter.default, merge=False)


def _take_other_results(merged: DictConfig, recorded: dict[str, Any]) -> None:
    """Set the recorded values of interpolations that lead to other values now."""
    resolved = dotted(_plain(merged))
    for path, value in recorded.items():
        if resolved.get(path) != value:
            OmegaConf.update(merged, path, value, merge=False)


def _leaves(config: Any) -> dict[str, Any]:
    """Return the settings that an evaluation repeats, by dotted path, without classes."""
    leaves = {}
    for path, value in dotted(config).items():
        if is_repeated(path) and not is_special(path):
            leaves[path] = value
    return leaves


def _node_of(cfg: DictConfig, path: str) -> tuple[Any, str]:
    """Return the node of a setting, empty if there is none, and the setting's name in it."""
    where, _, name = path.rpartition(".")
    node = OmegaConf.select(cfg, where)
    if not isinstance(node, DictConfig):
        node = {}
    return node, name


def _parameters(node: Any, path: str) -> dict[str, Parameter]:
    """Return the arguments of the class that a setting's node describes, if any."""
    if "_target_" not in node:
        return {}
    where = path.rpartition(".")[0]
    return signature(str(node["_target_"]), where)


def _restore(merged: DictConfig, cfg: DictConfig, path: str) -> None:
    """Set a setting that the user gave to the user's value, or remove it as the user did."""
    source, name = _node_of(cfg, path)
    target, _ = _node_of(merged, path)
    if source and not target:  # of a baseline that the run did not have
        _restore(merged, cfg, path.rpartition(".")[0])
    elif name in source:
        OmegaConf.update(merged, path, source._get_node(name), merge=False)
    elif name in target:
        del target[name]


def _names_code(value: Any) -> bool:
    """Return whether a value holds a special key such as ``_target_``, or an interpolation."""
    if isinstance(value, dict):
        has_special_key = any(str(key).startswith("_") for key in value)
        has_code = any(_names_code(item) for item in value.values())
        return has_special_key or has_code
    if isinstance(value, list):
        return any(_names_code(item) for item in value)
    return _is_interpolation(value)
