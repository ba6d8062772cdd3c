"""The text of ``--help``, from the declared settings and the files in ``conf/``."""

import re
import sys
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

from mops_lightning.config import settings
from mops_lightning.config.groups import PRESETS, conf_dir

if TYPE_CHECKING:
    from hydra.core.config_search_path import ConfigSearchPath

TEXT = "hydra/help/mops.yaml"
"""The file with the text, in ``conf/``."""


def text() -> str:
    """Return what ``--help`` prints, without importing Hydra."""
    import yaml  # type: ignore[import-untyped]

    parts = yaml.safe_load((conf_dir() / TEXT).read_text(encoding="utf-8"))
    inserted = {
        "${hydra.help.header}": parts["header"],
        "${selectable_groups:}": selectable_groups(),
        "${run_level_keys:}": run_level_keys(),
        "${hydra.help.footer}": parts["footer"],
    }
    return re.sub(r"\$\{.*?\}", lambda found: inserted[found[0]], parts["template"])


def run_level_keys() -> str:
    """Return the run-level keys with their texts."""
    shown = {name: one for name, one in settings.declared().items() if not one.group}
    width = max(map(len, shown)) + 2
    return "\n".join(
        textwrap.fill(
            one.help, 100, initial_indent=f"{name:<{width}}", subsequent_indent=" " * width
        )
        for name, one in shown.items()
    )


def selectable_groups() -> str:
    """Return the groups that users choose from with their choices, one per line.

    Files for one choice in particular (``sampler/mops/``) and for combinations of groups
    (``dataset_task/``) are left out: Hydra selects them.
    """
    folders = _folders()
    lines = []
    chosen = [name for name, one in settings.declared().items() if one.group]
    for top in (*chosen, *PRESETS):
        choices = _choices(folders, top)
        inner = _subgroups(folders, top)
        groups = [top, *(f"{top}/{name}" for name in inner if name not in choices)]
        lines += [f"{group}: {', '.join(_choices(folders, group))}" for group in groups]
    return "\n".join(sorted(lines))


def _folders() -> list[Path]:
    """Return ``conf/`` and, when Hydra has read the command line, the folder of --config-dir."""
    if "hydra" not in sys.modules:
        return [conf_dir()]
    from hydra.core.global_hydra import GlobalHydra

    if not GlobalHydra.instance().is_initialized():
        return [conf_dir()]
    # The loader's own methods copy all configuration files for each group: 0.15 s each time.
    search_path: ConfigSearchPath = GlobalHydra.instance().config_loader().get_search_path()
    paths = [str(entry.path) for entry in search_path.get_path()]
    files = [path.removeprefix("file://") for path in paths]
    return [Path(path) for path in files if "://" not in path]


def _choices(folders: list[Path], group: str) -> list[str]:
    """Return the names of the files of a group in all folders."""
    return sorted({path.stem for folder in folders for path in (folder / group).glob("*.yaml")})


def _subgroups(folders: list[Path], group: str) -> list[str]:
    """Return the names of the folders in a group in all folders."""
    inside = [path for folder in folders for path in (folder / group).glob("*")]
    return sorted({path.name for path in inside if path.is_dir()})
