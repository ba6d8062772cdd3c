"""Finding mistakes in a configuration before any heavy work."""

import math
from typing import Any

from omegaconf import DictConfig, OmegaConf

from mops_lightning.config import distributed
from mops_lightning.config.annotations import misfit
from mops_lightning.config.build import signature
from mops_lightning.errors import UserError, did_you_mean

RUN_KEYS = (
    "m",
    "sizes",
    "learn",
    "seed",
    "weights",
    "ckpt_path",
    "evaluate",
    "task_rate",
    "batch_size",
    "val_fraction",
    "noise",
    "pictures",
    "out",
    "cache",
    "epochs",
    "schedules",
    "augment",
    "pretrain",
    "paper",
    "rivals",
    "baselines",
    "labels",
    "names",
)
"""Keys of the configuration that are no group; ``--help`` says what each means."""

PRECISIONS = ("32-true", "bf16-mixed", "16-mixed")
"""What ``trainer.precision`` may be; Lightning has more."""

GROUPS = ("task", "dataset", "sampler", "optimizer", "trainer", "callbacks", "logger")
LEARN = ("task", "sampler", "joint", "nothing")


def check(cfg: DictConfig) -> None:
    """Find mistakes in a configuration before any heavy work.

    Raises:
        UserError: an unknown key (the nearest known one is named), a value out of range, or a
            ``_target_`` that cannot be imported or does not take one of its arguments.
    """
    known = (*RUN_KEYS, *GROUPS)
    for name in known:
        if name not in cfg and name != "logger":
            raise UserError(f"{name} cannot be removed. Choose another one with {name}=...")
    if not isinstance(cfg.task.get("net"), DictConfig):
        raise UserError("task.net cannot be removed. Choose another one with task/net=NAME.")
    for key in cfg:
        if str(key) not in known:
            raise UserError(f"Unknown setting {key!r}.{did_you_mean(str(key), known)}")
    if cfg.learn not in LEARN:
        raise UserError(f"learn: unknown value {cfg.learn!r}.{did_you_mean(str(cfg.learn), LEARN)}")
    _check_evaluation(cfg)
    _whole(cfg, "m", 1)
    _check_sizes(cfg.sizes)
    _whole(cfg, "seed", 0)
    _whole(cfg, "batch_size", 2)  # BatchNorm cannot learn from one cloud
    _whole(cfg, "pictures", 0)
    if not isinstance(cfg.task_rate, int | float) or cfg.task_rate <= 0:
        raise UserError(f"task_rate must be a number above 0, got {cfg.task_rate!r}.")
    if not isinstance(cfg.val_fraction, int | float) or not 0 <= cfg.val_fraction < 1:
        raise UserError(f"val_fraction must be in [0, 1), got {cfg.val_fraction!r}.")
    if not isinstance(cfg.noise, int | float) or not 0 <= cfg.noise < math.inf:
        raise UserError(f"noise must be a number of at least 0, got {cfg.noise!r}.")
    if "m_max" in cfg.sampler and cfg.learn != "task":
        _whole(cfg.sampler, "m_max", 1, "sampler.m_max")
    unused = ("sampler", "baselines") if cfg.learn == "task" else ()
    for group in {*GROUPS, "pretrain", "baselines"} - set(unused):
        _check_node(cfg.get(group), group)
    _whole(cfg.trainer, "max_epochs", int(cfg.learn != "nothing"), "trainer.max_epochs")
    if cfg.trainer.get("precision") not in (*PRECISIONS, "32", 32, None):
        got = str(cfg.trainer.precision)
        raise UserError(
            f"trainer.precision must be one of {', '.join(PRECISIONS)}, got {got!r}."
            f"{did_you_mean(got, PRECISIONS)}"
        )
    _whole(cfg.pretrain, "max_epochs", 1, "pretrain.max_epochs")
    distributed.check(cfg)
    points = cfg.dataset.get("n_points")
    if isinstance(points, int) and 1 <= points < cfg.m:
        raise UserError(
            f"m must be at most dataset.n_points={points}, got m={cfg.m}. "
            f"Try m={points} or dataset.n_points={cfg.m}."
        )


def _check_evaluation(cfg: DictConfig) -> None:
    if cfg.evaluate and cfg.learn not in ("nothing", "task"):
        raise UserError(
            f"evaluate: trains nothing, got learn={cfg.learn}. Leave learn out, or train anew "
            "without evaluate."
        )
    if not cfg.evaluate and cfg.weights == "run":
        raise UserError("weights=run means the run named by evaluate=RUN, which is not given.")
    if cfg.learn == "nothing" and cfg.ckpt_path is not None:
        raise UserError("ckpt_path resumes a training; to test a trained run give evaluate=RUN.")


def _check_sizes(sizes: Any) -> None:
    whole = OmegaConf.is_list(sizes) and all(type(size) is int for size in sizes)
    if sizes != "auto" and not (whole and len(sizes) and min(sizes) >= 1):
        raise UserError(
            f"sizes must be auto or a list of whole numbers of at least 1, got {sizes!r}. "
            "Try sizes=[8,16,32]."
        )


def _whole(cfg: DictConfig, key: str, least: int, name: str | None = None) -> None:
    value = cfg[key]
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise UserError(f"{name or key} must be a whole number of at least {least}, got {value!r}.")


def _check_node(node: Any, where: str) -> None:
    """Compare every ``_target_`` below ``node`` with its constructor's signature."""
    if not isinstance(node, DictConfig):
        return
    if node.get("_target_") is not None:
        parameters = signature(str(node["_target_"]), where)
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
            if name in parameters and not isinstance(node[key], DictConfig):
                value = node[key]
                value = OmegaConf.to_container(value) if OmegaConf.is_list(value) else value
                wanted = misfit(value, parameters[name].annotation)
                if wanted:
                    raise UserError(f"{where}.{name} must be {wanted}, got {value!r}.")
    for key in node:
        if not OmegaConf.is_missing(node, key):
            _check_node(node[key], f"{where}.{key!s}")
