"""Where conf/ is, what the run-level keys mean, and how nodes become objects."""

import inspect
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from mops_lightning.errors import UserError, did_you_mean

RUN_KEYS = (
    "m",
    "learn",
    "seed",
    "weights",
    "ckpt_path",
    "batch_size",
    "val_fraction",
    "pictures",
    "out",
    "cache",
    "epochs",
    "augment",
    "pretrain",
    "paper",
    "baselines",
    "labels",
    "names",
)
"""Keys of the configuration that are no group; ``--help`` says what each means."""

GROUPS = ("task", "dataset", "sampler", "optimizer", "trainer", "logger")
LEARN = ("task", "sampler", "joint")


def conf_dir() -> Path:
    """Return the folder with the Hydra groups: in the wheel, or at the top of a checkout.

    Raises:
        UserError: neither is there; the installation is broken.
    """
    here = Path(__file__).resolve().parent
    for folder in (here / "conf", here.parents[1] / "conf"):
        if (folder / "config.yaml").is_file():
            return folder
    raise UserError(
        f"conf/ is neither in {here} nor beside src/: reinstall with "
        "pip install --force-reinstall mops-lightning."
    )


def compose(overrides: list[str] | None = None) -> DictConfig:
    """Compose a configuration as the command line does, for notebooks and tests.

    Args:
        overrides: such as ``["m=64", "sampler=fps"]``.
    """
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from hydra.core.hydra_config import HydraConfig

    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        cfg = hydra_compose("config", overrides=overrides or [], return_hydra_config=True)
    HydraConfig.instance().set_config(cfg)
    plain = OmegaConf.masked_copy(cfg, [str(key) for key in cfg if key != "hydra"])
    # Names come from Hydra's choices; resolved here they outlive the global HydraConfig.
    plain.names = OmegaConf.to_container(cfg.names, resolve=True)
    return plain


def build(node: Any, **extra: Any) -> Any:
    """Make the object that a node describes; the only caller of Hydra's instantiate.

    Args:
        node: a configuration with ``_target_``.
        **extra: further arguments of the constructor, which no YAML could know.

    Raises:
        UserError: what the constructor itself found wrong, without Hydra's wrapping.
    """
    from hydra.errors import InstantiationException
    from hydra.utils import instantiate

    try:
        return instantiate(node, **extra, _convert_="all")
    except InstantiationException as error:
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, UserError):
                raise cause from None
            if type(cause).__name__ == "MisconfigurationException":
                # Lightning's word for a trainer that this machine cannot run, such as trainer=gpu.
                raise UserError(f"trainer: {cause} Try trainer=auto or trainer=cpu.") from None
            cause = cause.__cause__
        raise


def check(cfg: DictConfig) -> None:
    """Find mistakes in a configuration before any heavy work.

    Raises:
        UserError: an unknown key (the nearest known one is named), a value out of range, or a
            ``_target_`` that cannot be imported or does not take one of its arguments.
    """
    known = (*RUN_KEYS, *GROUPS)
    for key in cfg:
        if str(key) not in known:
            raise UserError(f"Unknown setting {key!r}.{did_you_mean(str(key), known)}")
    if cfg.learn not in LEARN:
        raise UserError(f"learn: unknown value {cfg.learn!r}.{did_you_mean(str(cfg.learn), LEARN)}")
    _whole(cfg, "m", 1)
    _whole(cfg, "seed", 0)
    _whole(cfg, "batch_size", 1)
    _whole(cfg, "pictures", 0)
    if not isinstance(cfg.val_fraction, int | float) or not 0 <= cfg.val_fraction < 1:
        raise UserError(f"val_fraction must be in [0, 1), got {cfg.val_fraction!r}.")
    unused = ("sampler", "baselines") if cfg.learn == "task" else ()
    for group in {*GROUPS, "pretrain", "baselines"} - set(unused):
        _check_node(cfg.get(group), group)
    epochs = cfg.trainer.get("max_epochs")
    if not isinstance(epochs, int) or isinstance(epochs, bool) or epochs < 1:
        raise UserError(f"trainer.max_epochs must be a whole number of at least 1, got {epochs!r}.")
    points = cfg.dataset.get("n_points")
    if isinstance(points, int) and cfg.m > points:
        raise UserError(
            f"m must be at most dataset.n_points={points}, got m={cfg.m}. "
            f"Try m={points} or dataset.n_points={cfg.m}."
        )


def _whole(cfg: DictConfig, key: str, least: int) -> None:
    value = cfg[key]
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise UserError(f"{key} must be a whole number of at least {least}, got {value!r}.")


def _check_node(node: Any, where: str) -> None:
    """Compare every ``_target_`` below ``node`` with its constructor's signature."""
    if not isinstance(node, DictConfig):
        return
    if node.get("_target_") is not None:
        parameters = _signature(str(node["_target_"]), where)
        takes_any = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
        for key in node:
            name = str(key)
            if not name.startswith("_") and name not in parameters and not takes_any:
                raise UserError(
                    f"{where}: {node['_target_']} takes no setting {name!r}."
                    f"{did_you_mean(name, parameters)}"
                )
            if OmegaConf.is_missing(node, key):
                raise UserError(f"{where}.{name} must be set: try {where}.{name}=VALUE.")
    for key in node:
        if not OmegaConf.is_missing(node, key):
            _check_node(node[key], f"{where}.{key!s}")


def _signature(target: str, where: str) -> dict[str, inspect.Parameter]:
    from hydra.utils import get_object

    try:
        found = get_object(target)
    except Exception as error:
        raise UserError(
            f"{where}._target_: cannot import {target!r}: {str(error).splitlines()[0]}"
        ) from None
    return dict(inspect.signature(found).parameters)
