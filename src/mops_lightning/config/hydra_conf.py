"""The folder ``conf/``, the resolvers that it uses, and composing a configuration from it."""

import textwrap
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from mops_lightning.config import settings
from mops_lightning.errors import UserError

NAMED = ("task", "task/net", "dataset", "sampler", "recipe")
"""The groups whose choices are in ``names``."""


def conf_dir() -> Path:
    """Return the folder with the Hydra groups: in the wheel, or at the top of a checkout.

    Raises:
        UserError: neither is there; the installation is broken.
    """
    here = Path(__file__).resolve().parents[1]
    for folder in (here / "conf", here.parents[1] / "conf"):
        if (folder / "config.yaml").is_file():
            return folder
    raise UserError(
        f"conf/ is neither in {here} nor next to src/: reinstall with "
        "pip install --force-reinstall mops-lightning."
    )


def composed(overrides: list[str]) -> DictConfig:
    """Compose a configuration; errors are raised by Hydra, OmegaConf and YAML."""
    from hydra import compose, initialize_config_dir
    from hydra.core.hydra_config import HydraConfig

    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        cfg = compose("config", overrides=overrides, return_hydra_config=True)
    HydraConfig.instance().set_config(cfg)
    plain = OmegaConf.masked_copy(cfg, [str(key) for key in cfg if key != "hydra"])
    # Names come from Hydra's choices; resolved here they outlive the global HydraConfig.
    plain.names = OmegaConf.to_container(cfg.names, resolve=True)
    return plain


def group_choices() -> DictConfig:
    """Return the names of the chosen task, task net, data set, sampler and recipe."""
    from hydra.core.hydra_config import HydraConfig

    choices = HydraConfig.get().runtime.choices
    # A node, so that interpolations find the names below it.
    return OmegaConf.create({group.rpartition("/")[2]: choices.get(group) for group in NAMED})


def run_label(_root_: DictConfig) -> str:
    """Return the label of a run's folder: the net that it trains, or the sampler and its size."""
    names = _root_.names
    if _root_.learn == "task":
        return str(names.net)
    if _root_.evaluate:  # the size is in the run's record
        return f"{names.sampler}-evaluated"
    size = _root_.sampler.get("m_max", _root_.m)
    return f"{names.sampler}-m{size}{'-joint' if _root_.learn == 'joint' else ''}"


def run_level_keys() -> str:
    """Return the run-level keys with their texts, for ``--help``."""
    shown = {name: one for name, one in settings.declared().items() if not one.group}
    width = max(map(len, shown)) + 2
    return "\n".join(
        textwrap.fill(
            one.help, 100, initial_indent=f"{name:<{width}}", subsequent_indent=" " * width
        )
        for name, one in shown.items()
    )


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


for resolver in (group_choices, run_label, run_level_keys, selectable_groups):
    OmegaConf.register_new_resolver(resolver.__name__, resolver, replace=True)
