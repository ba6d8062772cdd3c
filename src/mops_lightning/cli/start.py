"""Checks before Hydra writes anything into the folder of a single run."""

import sys
import traceback
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from mops_lightning.config import distributed, overrides, settings
from mops_lightning.config.build import accepted, build
from mops_lightning.config.compose import explain
from mops_lightning.errors import USER_ERROR, UserError, end, end_in_one_line, line_about, one_line
from mops_lightning.zoo import names

INPUTS = {
    "weights": ("auto", "run"),
    "pretrain_from": (),
    "ckpt_path": ("last",),
    "evaluate": (),
    "dataset.root": (),
}
"""Settings that name an existing file or folder, with values that are not paths."""
OUTPUTS = ("out", "cache", "dataset.cache")
MISSING = {
    "ckpt_path": "no checkpoint {}. Give a run's folder, a .ckpt file, or last.",
    "weights": "no file {}. Give a weights file, a run, a model, or weights=auto.",
    "pretrain_from": "no file {}. Give a weights file, a run or a model.",
}
"""Errors of inputs that nothing else checks before a run begins."""
NEEDS = {
    "sampler.anchor_width": "sampler.anchors",
    "sampler.num_sizes": "sampler.size_sampling=nested",
    "dataset.gap": "dataset.test_frames",
    "recipe.all_points_from": "recipe.train_points",
    "trainer.gradient_clip_algorithm": "trainer.gradient_clip_val",
    "recipe.distillation": "learn=sampler",
    "recipe.feature_distillation": "learn=sampler",
    "recipe.nets_per_step": "learn=sampler",
}
"""Settings without effect unless another one is set, or has the value behind ``=``."""
OF_TRAINED = ("recipe.", "optimizer.", "baselines.", "other_nets")
"""Settings of the training of a sampler, and of what a trained one is compared with."""
OF_JOINT = ("optimizer.", *(f"recipe.{name}" for name in settings.RECIPE_OF_TASK_NETS))
"""Those that also serve a task net trained on the points of an index sampler."""
UNTRAINED = "which is not trained"
LIGHTNING = ("trainer.", "logger.", "callbacks.")
"""Settings that are arguments of Lightning's classes."""


class RunStart(Callback):
    """Checks a single run and claims its folder, so that a refused run leaves nothing."""

    def on_run_start(self, config: DictConfig, **extra: Any) -> None:
        """Check the settings and claim the folder, before Hydra writes into it.

        Raises:
            SystemExit: a setting is wrong, or the folder contains a run; one line says so.
        """
        from mops_lightning.training.run.run import checked, claim

        HydraConfig.instance().set_config(config)  # the folder's name is made from it
        cfg = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
        try:
            folder = Path(config.hydra.run.dir)
            given = overrides.as_typed(config.hydra.overrides.task)
            complete = checked(cfg, given)
            if cfg.evaluate:  # the job gets the settings of the trained run
                with open_dict(config):
                    for name in complete:
                        config[name] = complete[name]
            else:
                check_effect(cfg, given)
            check_paths(cfg)
            distributed.check_start(cfg, overrides.as_typed(config.hydra.overrides.hydra))
            if not distributed.is_worker_rank(cfg):
                claim(folder)
        except OmegaConfBaseException as error:
            end("mops_lightning", explain(error, sys.argv[1:]), USER_ERROR)
        except Exception as error:
            end_in_one_line("mops_lightning", error)


def check_effect(cfg: DictConfig, given: list[str]) -> None:
    """Refuse a single run's settings that nothing follows; a sweep's cells may differ.

    Settings of a stage that is not run, such as ``epochs.joint``, are allowed.

    Args:
        cfg: the run's settings.
        given: the overrides that it was composed from.

    Raises:
        UserError: there is one.
    """
    is_trained = cache(partial(_is_trained, cfg))  # builds the sampler
    for argument in given:
        if reason := _why_without_effect(cfg, overrides.path(argument), is_trained):
            raise UserError(f"{argument}: has no effect {reason}. Leave it out.")


def _why_without_effect(cfg: DictConfig, path: str, is_trained: Callable[[], bool]) -> str:
    """Return why nothing follows a setting; empty if something may."""
    setting = settings.of(path)
    if path in settings.declared() and setting.group:
        return ""  # a choice may change settings of other groups
    if not setting.counts(cfg.learn):
        return f"with learn={cfg.learn}" if setting.learn else "beside task.net.points"
    name, _, value = NEEDS.get(path, "learn").partition("=")
    needed = OmegaConf.select(cfg, name)
    if not needed or (value and needed != value):
        return f"without {NEEDS[path]}"
    if path.startswith(("pretrain.", "pretrain_from")) and cfg.weights != "auto":
        return f"with weights={cfg.weights or 'null'}"
    trains_task = cfg.learn == "task" or (cfg.learn == "joint" and path.startswith(OF_JOINT))
    counts = trains_task or path == "recipe.task_points" or not path.startswith(OF_TRAINED)
    return "" if counts or is_trained() else f"with sampler={cfg.names.sampler}, {UNTRAINED}"


def _is_trained(cfg: DictConfig) -> bool:
    """Return whether the sampler has weights; one that is given the task net has its losses."""
    from hydra.utils import get_object

    from mops_lightning.samplers.base import Sampler  # imports torch

    if accepted(cfg.sampler, {"net": None}):
        return get_object(cfg.sampler._target_).losses is not Sampler.losses
    return bool(getattr(build(cfg.sampler, "sampler"), "learned", True))


def line_about_run(error: Exception, given: list[str]) -> str | None:
    """Return one line about an error of a run that the user can mend; None for any other.

    Lightning refuses some of its settings only when it uses them, by errors of any kind.

    Args:
        error: as it was raised.
        given: the overrides.
    """
    line = line_about(error)
    frames = list(traceback.walk_tb(error.__traceback__))
    if line is None and frames[-1][0].f_globals.get("__name__", "").startswith("lightning."):
        paths = {argument: overrides.path(argument) for argument in given}
        suspects = [
            argument
            for argument, path in paths.items()
            if path.startswith(LIGHTNING) and path not in settings.INSIDE
        ]
        if suspects:
            return f"{' '.join(suspects)}: not usable in this run: {one_line(error)}"
    return line


def check_paths(cfg: DictConfig) -> None:
    """Check that inputs exist and that no name is impossible: empty, too long, a loop of links.

    Raises:
        UserError: a setting names such a file or folder.
    """
    for name in (*INPUTS, *OUTPUTS):
        value = OmegaConf.select(cfg, name)
        if not isinstance(value, str) or value in INPUTS.get(name, ()):
            continue
        if not value:
            raise UserError(f"{name}: no path is given. Give one, or leave {name} out.")
        try:
            path = Path(value).expanduser()
            path.stat()
        except FileNotFoundError:
            _check_missing(name, value)
        except (OSError, RuntimeError, ValueError) as error:
            # Python: no such user, a null byte.
            reason = error.strerror if isinstance(error, OSError) else str(error)
            raise UserError(f"{name}: {value[:100]}: {str(reason).rstrip('.')}.") from None


def _check_missing(name: str, value: str) -> None:
    """Refuse a path that does not exist where the setting needs one; weights may be of a model."""
    if name not in MISSING:
        return
    try:
        found = name != "ckpt_path" and names.resolve(value).exists()
    except UserError as error:
        raise UserError(f"{name}: {error}") from None
    if not found:
        raise UserError(f"{name}: {MISSING[name].format(value)}")
