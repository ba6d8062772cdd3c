"""OmegaConf resolvers that conf/ uses; importing this module registers them."""

from collections.abc import Mapping
from typing import Any

from omegaconf import DictConfig, OmegaConf

from mops_lightning.config import settings
from mops_lightning.errors import UserError, did_you_mean


def choose(key: str, table: Mapping[str, Any], otherwise: Any) -> Any:
    """Return a table's entry for a key, ``otherwise`` where it has none."""
    return table.get(key, otherwise)


def group_choices() -> DictConfig:
    """Return the names of the chosen task, task net, data set, sampler and recipe."""
    from hydra.core.hydra_config import HydraConfig

    choices = HydraConfig.get().runtime.choices
    groups = {"task": "task", "net": "task/net", "dataset": "dataset", "sampler": "sampler"}
    groups["recipe"] = "recipe"
    # A node, so that interpolations find the names below it.
    return OmegaConf.create({name: choices.get(group) for name, group in groups.items()})


def model_for(model: str, settings: Mapping[str, Any], _root_: DictConfig) -> str:
    """Return a model that fits a run with these settings, and ``auto`` for other runs.

    A run that trains the task net alone gets ``auto``, because it would start from the model.
    """
    fits = all(OmegaConf.select(_root_, key) == value for key, value in settings.items())
    return model if fits and _root_.learn != "task" else "auto"


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


def selectable_groups() -> str:
    """Return the groups that users choose from with their choices, one per line, for ``--help``.

    Files for one choice in particular (``sampler/mops/``) and for combinations of groups
    (``dataset_task/``) are left out: Hydra selects them.
    """
    from hydra._internal.config_repository import ConfigRepository
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.object_type import ObjectType

    # Hydra resolves the text of --help twice per command, and the loader's own methods copy all
    # configuration files for each group: 0.15 s each time.
    files = ConfigRepository(GlobalHydra.instance().config_loader().get_search_path())
    lines = []
    for top in (*(name for name, one in settings.declared().items() if one.group), "experiment"):
        choices = files.get_group_options(top)
        inner = files.get_group_options(top, ObjectType.GROUP)
        groups = [top, *(f"{top}/{name}" for name in inner if name not in choices)]
        lines += [f"{group}: {', '.join(files.get_group_options(group))}" for group in groups]
    return "\n".join(sorted(lines))


def register() -> None:
    """Register all resolvers."""
    for resolver in (choose, group_choices, model_for, run_label, selectable_groups):
        OmegaConf.register_new_resolver(resolver.__name__, resolver, replace=True)


register()
