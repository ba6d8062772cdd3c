"""Resolvers of the files in ``conf/``: the names of a run, its folder and its groups.

A file calls one as ``${run_label:${}}``; OmegaConf passes the whole configuration as ``_root_``.
"""

from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from mops_lightning.config import overrides
from mops_lightning.config.help import run_level_keys, selectable_groups

NAMED = {
    "task": "task",
    "dataset": "dataset",
    "sampler": "sampler",
    "recipe": "recipe",
    "net": "task/net",
    "stages": "sampler@task.net.sampler",
}
"""The groups whose choices are in ``names``, by name."""

OWN = "own"
"""The choice of a group for a class of the user's own."""

NOT_IN_LABELS = ("/", ".", "..", "~")
"""Parts of a path that say nothing about a run."""


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
    if _root_.learn == "task":
        return str(_root_.names.net)
    label = sampler_label(_root_)
    if _root_.evaluate:  # the size is in the run's record
        return f"{label}-evaluated"
    sampler = _root_.sampler
    if sampler.get("anchors"):
        label += "-anchored"
    label += f"-m{sampler.get('m_max', _root_.m)}"
    if _root_.learn == "joint":
        label += "-joint"
    return label


def sampler_label(_root_: DictConfig) -> str:
    """Return the name of the sampler: its choice, or the class of a sampler of the user's own."""
    name = str(_root_.names.sampler)
    if name != OWN:
        return name
    return str(_root_.sampler.get("_target_")).rpartition(".")[2]


def tested_label(_root_: DictConfig) -> str:
    """Return the label of a test's folder: the run or model that it tests, else the sampler.

    The size of a tested run is in its own name or record; one that is given with it is named.
    """
    from hydra.core.hydra_config import HydraConfig

    if not _root_.evaluate:
        return f"{sampler_label(_root_)}-m{_root_.m}"
    parts = [part for part in Path(_root_.evaluate).parts if part not in NOT_IN_LABELS]
    label = "-".join(parts[-2:])  # of a cell of a sweep: the sweep and the cell
    given = [overrides.path(argument) for argument in HydraConfig.get().overrides.task]
    if "m" in given:
        label += f"-m{_root_.m}"
    return label


RESOLVERS = (
    group_choices,
    run_label,
    sampler_label,
    tested_label,
    run_level_keys,
    selectable_groups,
    min,
)


def register() -> None:
    """Make the resolvers known to OmegaConf."""
    for resolver in RESOLVERS:
        OmegaConf.register_new_resolver(resolver.__name__, resolver, replace=True)
