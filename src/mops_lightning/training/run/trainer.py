"""Building Lightning's trainer from the settings of a run."""

import logging
import warnings
from pathlib import Path
from typing import Any

import lightning as L
from lightning.fabric.plugins import CheckpointIO
from lightning.pytorch.callbacks import Callback, Checkpoint, ProgressBar
from lightning.pytorch.profilers import AdvancedProfiler, PyTorchProfiler, SimpleProfiler
from omegaconf import DictConfig, OmegaConf, open_dict

from mops_lightning.config.build import build, build_as
from mops_lightning.data.clouds import CloudDataset
from mops_lightning.data.loader import CloudLoader
from mops_lightning.errors import UserError
from mops_lightning.training.checkpoint import CHECKPOINT
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.recipe.moving_average import MovingAverage
from mops_lightning.training.run.callbacks import (
    CPUTime,
    EpochLines,
    KeepsStart,
    build_callbacks,
)
from mops_lightning.training.run.checkpoint_io import AtomicCheckpointIO
from mops_lightning.training.run.ending import (
    KeepsEnding,
    StopBetweenSteps,
    StopWithCheckpoint,
)
from mops_lightning.training.run.loggers import build_logger
from mops_lightning.training.run.memory import keep_freed_memory

HARMLESS = (
    ".*does not have many workers.*",  # the data are in memory; workers would only copy them
    ".*no `val_dataloader`.*",  # val_fraction=0 is a choice
    ".*Checkpoint directory .* exists and is not empty.*",  # a pretraining resumes in its folder
    ".*dirpath has changed.*",  # a resumed run has its own folder
    ".*module.s. in eval mode at the start.*",  # frozen parts stay in evaluation mode
    ".*smaller than the logging interval.*",  # the interval is lowered for small data sets
    ".*isinstance.treespec, LeafSpec.*",  # Lightning 2.6 uses a name that torch 2.13 deprecates
    ".*GPU available but not used.*",  # trainer=cpu is a choice
    ".*AMP with fp16 is not supported on CPU.*",  # make_trainer raises an error
    ".*`self.log.*` but `Trainer.barebones=True.` is configured.*",  # the run's last line says so
)
"""Warnings about intended behaviour."""

PROFILERS = {"simple": SimpleProfiler, "advanced": AdvancedProfiler, "pytorch": PyTorchProfiler}
"""Profilers with a report as text, by Lightning's names."""
BUILT_HERE = ("plugins", "profiler")
"""Arguments of the trainer whose settings may describe objects."""
PROFILE = "profile"
"""Name of a profiler's report, behind its stage."""
LOG_EVERY = 10
"""Steps between two points of a curve."""


def make_trainer(
    cfg: DictConfig, folder: Path, dataset: CloudDataset, experiment: Experiment, clouds: int
) -> L.Trainer:
    """Build the trainer with this run's callbacks and logger.

    Args:
        cfg: a composed configuration.
        folder: the run's folder.
        dataset: the data, of which some clouds are drawn.
        experiment: gives the task and the recipe.
        clouds: number of clouds to train on.

    Raises:
        UserError: a setting of the trainer, a callback or the logger is wrong, or this machine
            cannot do what they specify.
    """
    _silence_lightning()
    keep_freed_memory()
    node = cfg.trainer
    logger: Any = False
    if cfg.get("logger") and not node.get("barebones"):
        logger = build_logger(cfg.logger, folder, shown_score(experiment))
    callbacks = [
        *_moving_average(experiment),  # before the callbacks that save it
        *_callbacks_of_settings(cfg, folder, dataset, experiment, logged=bool(logger)),
        _stop_callback(node, folder),
        CPUTime(),
        KeepsStart(),
        KeepsEnding(),
    ]
    defaults = {
        "default_root_dir": str(folder),
        "num_sanity_val_steps": 0,
        "enable_model_summary": False,
        "log_every_n_steps": _log_every(node, clouds // cfg.batch_size),
        "enable_progress_bar": any(isinstance(callback, ProgressBar) for callback in callbacks),
        "enable_checkpointing": any(isinstance(callback, Checkpoint) for callback in callbacks),
    }
    trainer: L.Trainer = build_as(
        L.Trainer,
        _without(node, BUILT_HERE),
        "trainer",
        offered={name: value for name, value in defaults.items() if name not in node},
        logger=logger,
        callbacks=callbacks,
        plugins=_plugins(node),
        profiler=_profiler(node, folder),
    )
    if node.get("precision") == "16-mixed" and trainer.precision != "16-mixed":
        raise UserError(
            "trainer.precision=16-mixed needs a GPU, and none was found. Try trainer.precision="
            "bf16-mixed."
        )
    is_on_cpus = trainer.strategy.root_device.type == "cpu"
    if node.get("sync_batchnorm") and trainer.world_size > 1 and is_on_cpus:
        raise UserError("trainer.sync_batchnorm=true needs GPUs, and none was found. Leave it out.")
    return trainer


def shown_score(experiment: Experiment) -> str:
    """Return the metric that is shown during the training."""
    task = experiment.task
    if experiment.learn == "task" and task.full_score:
        return task.full_score
    return task.score


def _without(node: DictConfig, names: tuple[str, ...]) -> DictConfig:
    """Return a copy of settings without some of them."""
    copy = node.copy()
    with open_dict(copy):
        for name in names:
            copy.pop(name, None)
    return copy


def _log_every(trainer: DictConfig, steps_of_epoch: int) -> int:
    """Return the steps between two points of a curve; 0 for no curves, as barebones wants."""
    if trainer.get("barebones"):
        return 0
    # An epoch of a small data set may be shorter than the logging interval.
    return max(1, min(LOG_EVERY, steps_of_epoch))


def _moving_average(experiment: Experiment) -> list[Callback]:
    """Return the recipe's moving average of the weights, if it has one."""
    span = experiment.recipe.ema_span
    return [MovingAverage(span)] if span else []


def _callbacks_of_settings(
    cfg: DictConfig, folder: Path, dataset: CloudDataset, experiment: Experiment, logged: bool
) -> list[Callback]:
    """Build the callbacks that the settings list, except those that the trainer's switch off."""
    score = shown_score(experiment)
    offered: dict[str, Any] = {
        "folder": folder,
        "checkpoint": _checkpoint(folder),
        "score": score,
    }
    if cfg.pictures:
        offered |= _pictured(cfg, dataset, experiment)
    has_progress_bar = _is_enabled(cfg.trainer, "enable_progress_bar")
    has_checkpoints = _is_enabled(cfg.trainer, "enable_checkpointing")
    callbacks: list[Callback] = []
    for callback in build_callbacks(cfg.callbacks, offered, logged=logged):
        if isinstance(callback, ProgressBar) and not has_progress_bar:
            callbacks.append(EpochLines(score))
        elif isinstance(callback, Checkpoint) and not has_checkpoints:
            continue
        else:
            callbacks.append(callback)
    return callbacks


def _pictured(cfg: DictConfig, dataset: CloudDataset, experiment: Experiment) -> dict[str, Any]:
    """Return the test clouds to draw, as arguments of the callback that draws them."""
    from mops_lightning.training.run.pictures import clouds_to_draw  # imports matplotlib

    rows, titles = clouds_to_draw(dataset, cfg.pictures)
    make_batch = experiment.task.make_batch
    loader = CloudLoader(dataset.test, cfg.batch_size, make_batch=make_batch)
    return {"batch": loader.batch_of(rows), "titles": titles, "channels": dataset.channels}


def _is_enabled(trainer: DictConfig, name: str) -> bool:
    """Return whether settings of the trainer leave something on; barebones switches all off."""
    return trainer.get(name) is not False and not trainer.get("barebones")


def _checkpoint(folder: Path) -> Path:
    return folder / "checkpoints" / CHECKPOINT


def _stop_callback(trainer: DictConfig, folder: Path) -> Callback:
    """Return the callback for Ctrl-C, which writes a checkpoint where the run writes any."""
    if _is_enabled(trainer, "enable_checkpointing") and not trainer.get("fast_dev_run"):
        return StopWithCheckpoint(_checkpoint(folder))
    return StopBetweenSteps(None)


def _plugins(node: DictConfig) -> list[Any]:
    """Return the plugins that the settings name, and the one that writes checkpoints safely.

    Raises:
        UserError: another plugin that writes checkpoints is named.
    """
    named = node.get("plugins")
    if named is None:
        return [AtomicCheckpointIO()]
    if not OmegaConf.is_list(named):
        named = [named]
    plugins = []
    for plugin in named:
        if OmegaConf.is_dict(plugin):
            plugin = build(plugin, "trainer.plugins")
        if isinstance(plugin, CheckpointIO):
            raise UserError(
                f"trainer.plugins: {type(plugin).__name__} cannot be used, because checkpoints are "
                "written with a checksum that resuming needs. Leave it out."
            )
        plugins.append(plugin)
    return [*plugins, AtomicCheckpointIO()]


def _profiler(node: DictConfig, folder: Path) -> Any:
    """Return the profiler that the settings name, which writes its report into the run's folder."""
    named = node.get("profiler")
    if OmegaConf.is_dict(named):
        return build(named, "trainer.profiler")
    if named not in PROFILERS:
        return named  # Lightning names the ones that it knows
    return PROFILERS[named](dirpath=folder, filename=PROFILE)


def show_profile(folder: Path, stage: str) -> None:
    """Print the profiler's report of a stage, ``fit`` or ``test``, if there is one."""
    path = folder / f"{stage}-{PROFILE}.txt"
    if path.is_file():
        print(path.read_text().strip())


def _silence_lightning() -> None:
    for name in ("lightning.pytorch", "lightning.fabric", "lightning"):
        # Under Hydra each line would appear twice, once from Lightning's own handler.
        logging.getLogger(name).handlers.clear()
        logging.getLogger(name).setLevel(logging.WARNING)
    for message in HARMLESS:
        warnings.filterwarnings("ignore", message=message)
