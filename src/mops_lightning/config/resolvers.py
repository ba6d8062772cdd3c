"""OmegaConf resolvers that conf/ uses; importing this module registers them."""

from collections.abc import Mapping
from typing import Any

from omegaconf import DictConfig, OmegaConf

from mops_lightning.errors import UserError, did_you_mean


def choose(key: str, table: Mapping[str, Any], otherwise: Any) -> Any:
    """Return a table's entry for a key, ``otherwise`` where it has none."""
    return table.get(key, otherwise)


def group_choices() -> DictConfig:
    """Return the names of the chosen task, task net, data set and sampler."""
    from hydra.core.hydra_config import HydraConfig

    choices = HydraConfig.get().runtime.choices
    groups = {"task": "task", "net": "task/net", "dataset": "dataset", "sampler": "sampler"}
    # A node, so that interpolations find the names below it.
    return OmegaConf.create({name: choices.get(group) for name, group in groups.items()})


def run_label(_root_: DictConfig) -> str:
    """Return what a run's folder is called: the net it trains, or the sampler, its size and more.

    Raises:
        UserError: ``learn`` is unknown.
    """
    suffixes = {"task": "", "sampler": "", "joint": "-joint", "nothing": "-evaluated"}
    if _root_.learn not in suffixes:
        hint = did_you_mean(str(_root_.learn), suffixes)
        raise UserError(f"learn: unknown value {_root_.learn!r}.{hint}")
    if _root_.learn == "task":
        return str(_root_.names.net)
    size = _root_.sampler.get("m_max", _root_.m)
    return f"{_root_.names.sampler}-m{size}{suffixes[_root_.learn]}"


def register() -> None:
    """Register all resolvers."""
    for resolver in (choose, group_choices, run_label):
        OmegaConf.register_new_resolver(resolver.__name__, resolver, replace=True)


register()
