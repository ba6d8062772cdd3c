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

WIDTH = 100
"""Characters of a line."""

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
    texts = {}
    for name, setting in settings.declared().items():
        if not setting.group:
            texts[name] = setting.help
    width = max(len(name) for name in texts) + 2
    paragraphs = []
    for name, text in texts.items():
        head = name.ljust(width)
        indent = " " * width
        paragraphs.append(textwrap.fill(text, WIDTH, initial_indent=head, subsequent_indent=indent))
    return "\n".join(paragraphs)


def selectable_groups() -> str:
    """Return the groups that users choose from with their choices, one per line.

    Files for one choice in particular (``sampler/mops/``) and for combinations of groups
    (``dataset_task/``) are left out: Hydra selects them.
    """
    folders = _folders()
    lines = []
    tops = [name for name, setting in settings.declared().items() if setting.group]
    for top in (*tops, *PRESETS):
        choices = _choices(folders, top)
        lines.append(f"{top}: {', '.join(choices)}")
        for name in _subgroups(folders, top):
            if name in choices:  # files for this choice in particular
                continue
            group = f"{top}/{name}"
            lines.append(f"{group}: {', '.join(_choices(folders, group))}")
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
    folders = []
    for entry in search_path.get_path():
        path = str(entry.path).removeprefix("file://")
        if "://" not in path:
            folders.append(Path(path))
    return folders


def _choices(folders: list[Path], group: str) -> list[str]:
    """Return the names of the files of a group in all folders."""
    names = set()
    for folder in folders:
        for path in (folder / group).glob("*.yaml"):
            names.add(path.stem)
    return sorted(names)


def _subgroups(folders: list[Path], group: str) -> list[str]:
    """Return the names of the folders in a group in all folders."""
    names = set()
    for folder in folders:
        for path in (folder / group).glob("*"):
            if path.is_dir():
                names.add(path.name)
    return sorted(names)
