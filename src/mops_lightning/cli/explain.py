"""Hydra's and OmegaConf's errors as one line that names the setting and the nearest known one."""

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from mops_lightning.config import settings
from mops_lightning.config.compose import conf_dir
from mops_lightning.config.validate import misfit_of
from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.records.migrate import answer

if TYPE_CHECKING:
    from omegaconf import DictConfig


FROM_RESOLVER = f"{UserError.__name__} raised while resolving interpolation: "
"""What OmegaConf puts before the error of a resolver."""


def explain(error: BaseException) -> str:
    """Turn an error into one line that names the setting and the nearest known one."""
    from hydra.errors import MissingConfigException

    refused = misfit_of(error)
    if refused is not None:
        return str(refused)
    texts = []
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, MissingConfigException) and cause.missing_cfg_file:
            if not cause.options:
                return f"no file {cause.missing_cfg_file} in --config-dir.{_names_there(cause)}"
            group, _, choice = cause.missing_cfg_file.rpartition("/")
            return f"{group}={choice}: no such choice.{did_you_mean(choice, cause.options or ())}"
        texts.append(str(cause).strip())
        cause = cause.__cause__
    if isinstance(error, UserError):
        return texts[0]
    for text in texts:
        if text.startswith(FROM_RESOLVER):
            return text.removeprefix(FROM_RESOLVER).splitlines()[0]
        if "Interpolation key '" in text:
            key = text.split("Interpolation key '")[1].split("'")[0]
            if said := answer(key):
                return said
        if "Could not override '" in text:
            key = text.split("Could not override '")[1].split("'")[0]
            return _no_such_setting(key)
    # Hydra's and OmegaConf's own messages, without their notes for developers.
    lines = [line for text in texts for line in text.splitlines() if line.strip()]
    return " ".join(dict.fromkeys(line.strip() for line in lines if line[0] != " "))


def _names_there(cause: Any) -> str:
    """Name the configurations in the folder of --config-dir."""
    from pathlib import Path

    places = [i for i, a in enumerate(sys.argv) if a in ("--config-dir", "-cd")]
    root = Path(sys.argv[places[-1] + 1]) if places else conf_dir()
    names = [str(path.relative_to(root).with_suffix("")) for path in root.rglob("*.yaml")]
    return did_you_mean(cause.missing_cfg_file, names)


def _no_such_setting(key: str) -> str:
    """Name the nearest group or setting, or say how to set an argument that no YAML file sets."""
    from omegaconf import OmegaConf

    from mops_lightning.config.build import signature

    root = conf_dir()
    paths = [str(path.relative_to(root)) for path in root.rglob("*") if path.is_dir()]
    groups = [path for path in paths if not path.startswith("hydra")]
    if said := answer(key):
        return said
    if "/" in key or "@" in key:
        return f"{key}: no such group of choices.{did_you_mean(key, groups)}"
    cfg = _composed(groups)
    node, _, name = key.rpartition(".")
    target = OmegaConf.select(cfg, f"{node}._target_")
    if target and name in signature(target, node):
        return f"{key}: {target} accepts it, but no file sets it. Write +{key}=..."
    hint = did_you_mean(key, [known for known in _known_keys(cfg) if known != key])
    return f"{key}: no such setting.{hint} --cfg job shows all of them."


def _composed(groups: Sequence[str]) -> "DictConfig":
    """Compose the groups that the command line chooses, without its other settings."""
    from mops_lightning.config.compose import compose
    from mops_lightning.config.overrides import key

    try:
        return compose([part for part in sys.argv[1:] if key(part) in groups])
    except Exception:  # the mistake may be among them
        return compose()


def _known_keys(cfg: "DictConfig") -> list[str]:
    """List every key of a configuration, dotted."""
    from omegaconf import DictConfig

    keys = list(settings.declared())

    def walk(node: DictConfig, prefix: str) -> None:
        for key in node:
            keys.append(prefix + str(key))
            value = node._get_node(key)
            if isinstance(value, DictConfig) and value._is_none() is False:
                walk(value, f"{prefix}{key!s}.")

    walk(cfg, "")
    return sorted({key for key in keys if not key.split(".")[-1].startswith("_")})
