"""Composing from the same files of conf/ once: that takes three quarters of Hydra's time."""

import copy
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

from hydra._internal import config_loader_impl, defaults_list
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.plugins import Plugins

from mops_lightning.config import settings

ROOT = Path(__file__).parents[2]
SCHEMA = settings.SCHEMA


def keep_choices() -> None:
    """Let Hydra read each file, and find and merge those of equal choices, once; never values."""
    hydra: Any = config_loader_impl
    loader = hydra.ConfigLoaderImpl
    find = hydra.create_defaults_list
    merge = loader._compose_config_from_defaults_list
    Plugins.instance()  # imports the sources' modules anew
    source: Any = SourcesRegistry.instance().resolve("file")
    read = source.load_config
    kept: dict[Any, bytes] = {}

    def once(sources: Any, key: Any, function: Any, *arguments: Any, **how: Any) -> Any:
        """Call the function, or take what it returned; what a test writes may change."""
        places = tuple(one.path for one in sources if one.scheme() == "file")
        if settings.SCHEMA is not SCHEMA or not all(Path(p).is_relative_to(ROOT) for p in places):
            return function(*arguments, **how)
        key = (function, places, key)
        if key not in kept:
            kept[key] = pickle.dumps(function(*arguments, **how))
        return pickle.loads(kept[key])  # a new copy, many times as fast as copy.deepcopy

    def find_once(repo: Any, config_name: Any, overrides_list: Any, **how: bool) -> Any:
        values = defaults_list.Overrides(repo, overrides_list).config_overrides
        choices = [one for one in overrides_list if not any(one is value for value in values)]
        chosen = [one.input_line for one in choices if not one.is_sweep_override()]
        key = (config_name, *chosen, *how.values())
        found = once(repo.get_sources(), key, find, repo, config_name, choices, **how)
        return replace(found, config_overrides=values)

    def merge_once(self: Any, defaults: Any, repo: Any) -> Any:
        return once(repo.get_sources(), repr(defaults), merge, self, defaults, repo)

    def read_once(self: Any, config_path: str) -> Any:
        return once([self], config_path, read, self, config_path)

    def begin(self: Any, delegate: Any) -> None:
        self.delegate, self.cache = copy.copy(delegate), {}  # its sources are replaced, not changed

    hydra.CachingConfigRepository.__init__ = begin
    hydra.create_defaults_list = find_once
    loader._compose_config_from_defaults_list = merge_once
    source.load_config = read_once
