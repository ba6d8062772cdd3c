"""Building Lightning's trainer, and its setup beyond training."""

import ctypes
import io
import logging
import sys
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.fabric.plugins import CheckpointIO, TorchCheckpointIO
from lightning.pytorch.callbacks import Callback, Checkpoint, ProgressBar
from lightning.pytorch.loggers import Logger
from lightning.pytorch.profilers import AdvancedProfiler, PyTorchProfiler, SimpleProfiler
from omegaconf import DictConfig, OmegaConf, open_dict

from mops_lightning.config.build import build, build_as
from mops_lightning.data.clouds import CloudDataset
from mops_lightning.data.loader import CloudLoader
from mops_lightning.errors import UserError
from mops_lightning.filesystem import atomic_write
from mops_lightning.records.run_record import RunRecord
from mops_lightning.training.checkpoint import CHECKPOINT, sealed
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.recipe.moving_average import MovingAverage
from mops_lightning.training.run.board import Board
from mops_lightning.training.run.callbacks import CPUTime, EpochLines, build_callbacks
from mops_lightning.training.run.ending import (
    KeepsEnding,
    StopBetweenSteps,
    StopWithCheckpoint,
)
from mops_lightning.tree import dotted

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
LOGGER_FOLDERS = {"Board": "", "TensorBoardLogger": "", "CSVLogger": "csv"}
"""Subfolder of the run's folder that a logger writes to. TensorBoard calls a run by its folder."""

M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_MAX = -1, -2, -4
"""Options of mallopt(3)."""


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes checkpoints next to their target and then replaces it.

    Lightning's own writer uses a temporary file in ``TMPDIR``. If that is another file system, the
    last step is a copy, and a kill or a full disk during the copy destroys the previous checkpoint.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any | None = None
    ) -> None:
        """Write ``checkpoint`` to ``path``; until it is complete, the previous one stays.

        Args:
            checkpoint: as Lightning makes it.
            path: of a local file.
            storage_options: not used.
        """
        buffer = io.BytesIO()  # torch.save hides the OSError of a full disk
        torch.save(checkpoint, buffer)
        with atomic_write(path) as temporary:
            temporary.write_bytes(sealed(buffer.getvalue()))


def make_trainer(
    cfg: DictConfig, folder: Path, dataset: CloudDataset, experiment: Experiment, clouds: int
) -> L.Trainer:
    """Build the trainer with this run's callbacks and logger.

    Args:
        cfg: a composed configuration.
        folder: the run's folder.
        dataset: for the pictured clouds.
        experiment: for its task and recipe.
        clouds: number of clouds to train on.

    Raises:
        UserError: a setting of the trainer, a callback or the logger is wrong, or this machine
            cannot do what they specify.
    """
    _silence_lightning()
    keep_freed_memory()
    given = cfg.trainer
    score = _score(experiment)
    logger: Any = False
    if cfg.get("logger") and not given.get("barebones"):
        logger = _logger(cfg.logger, folder, score)
    callbacks = [
        *_moving_average(experiment),  # before the callbacks that save it
        *_chosen_callbacks(cfg, folder, dataset, experiment, logged=bool(logger)),
        _stop(given, folder),
        CPUTime(),
        KeepsEnding(),
    ]
    defaults = {
        "default_root_dir": str(folder),
        "num_sanity_val_steps": 0,
        "enable_model_summary": False,
        "log_every_n_steps": _log_every(given, clouds // cfg.batch_size),
        "enable_progress_bar": any(isinstance(callback, ProgressBar) for callback in callbacks),
        "enable_checkpointing": any(isinstance(callback, Checkpoint) for callback in callbacks),
    }
    settings = given.copy()
    with open_dict(settings):
        for name in BUILT_HERE:
            settings.pop(name, None)
    trainer: L.Trainer = build_as(
        L.Trainer,
        settings,
        "trainer",
        offered={name: value for name, value in defaults.items() if name not in given},
        logger=logger,
        callbacks=callbacks,
        plugins=_plugins(given),
        profiler=_profiler(given, folder),
    )
    if given.get("precision") == "16-mixed" and trainer.precision != "16-mixed":
        raise UserError(
            "trainer.precision=16-mixed needs a GPU, and none was found. Try trainer.precision="
            "bf16-mixed."
        )
    return trainer


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


def _chosen_callbacks(
    cfg: DictConfig, folder: Path, dataset: CloudDataset, experiment: Experiment, logged: bool
) -> list[Callback]:
    """Build the callbacks that the settings list, without those that the trainer's exclude."""
    score = _score(experiment)
    offered: dict[str, Any] = {
        "folder": folder,
        "checkpoint": _checkpoint(folder),
        "score": score,
    }
    if cfg.pictures:
        from mops_lightning.training.run.pictures import clouds_to_draw  # imports matplotlib

        rows, titles = clouds_to_draw(dataset, cfg.pictures)
        make_batch = experiment.task.make_batch
        loader = CloudLoader(dataset.test, cfg.batch_size, make_batch=make_batch)
        offered["batch"] = loader.batch_of(rows)
        offered["titles"] = titles
        offered["channels"] = dataset.channels
    chosen: list[Callback] = []
    for callback in build_callbacks(cfg.callbacks, offered, logged=logged):
        if isinstance(callback, ProgressBar) and not _has(cfg.trainer, "enable_progress_bar"):
            chosen.append(EpochLines(score))
        elif not isinstance(callback, Checkpoint) or _has(cfg.trainer, "enable_checkpointing"):
            chosen.append(callback)
    return chosen


def _has(trainer: DictConfig, name: str) -> bool:
    """Return whether the trainer has a part; ``trainer.barebones`` leaves all out."""
    return trainer.get(name) is not False and not trainer.get("barebones")


def _checkpoint(folder: Path) -> Path:
    return folder / "checkpoints" / CHECKPOINT


def _stop(trainer: DictConfig, folder: Path) -> Callback:
    """Return the callback for Ctrl-C, which writes a checkpoint where the run writes any."""
    writes = _has(trainer, "enable_checkpointing") and not trainer.get("fast_dev_run")
    if writes:
        return StopWithCheckpoint(_checkpoint(folder))
    return StopBetweenSteps(None)


def _plugins(given: DictConfig) -> list[Any]:
    """Return the plugins that the settings name, and the one that writes checkpoints safely.

    Raises:
        UserError: another plugin that writes checkpoints is named.
    """
    named = given.get("plugins")
    if named is None:
        return [AtomicCheckpointIO()]
    several = named if OmegaConf.is_list(named) else [named]
    plugins = []
    for plugin in several:
        if OmegaConf.is_dict(plugin):
            plugin = build(plugin, "trainer.plugins")
        if isinstance(plugin, CheckpointIO):
            raise UserError(
                f"trainer.plugins: {type(plugin).__name__} cannot be used, because checkpoints are "
                "written with a checksum that resuming needs. Leave it out."
            )
        plugins.append(plugin)
    return [*plugins, AtomicCheckpointIO()]


def _profiler(given: DictConfig, folder: Path) -> Any:
    """Return the profiler that the settings name, which writes its report into the run's folder."""
    named = given.get("profiler")
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


def _score(experiment: Experiment) -> str:
    """Return the metric that is shown during the training."""
    task = experiment.task
    if experiment.learn == "task" and task.full_score:
        return task.full_score
    return task.score


def _logger(node: DictConfig, folder: Path, score: str) -> Any:
    """Build the logger, which writes into the run's folder itself unless it has a name."""
    offered = {"name": "", "score": score}
    below = LOGGER_FOLDERS.get(node["_target_"].rpartition(".")[2])
    if below is not None:
        offered["name"] = below
        offered["version"] = ""  # the progress bar would show a version
    unset = {name: value for name, value in offered.items() if name not in node}
    return build_as(Logger, node, "logger", unset, save_dir=str(folder))


def finish_loggers(trainer: L.Trainer) -> None:
    """End what a logger keeps open for its process: the next run of a sweep would continue it."""
    for logger in trainer.loggers:
        if type(logger).__name__ == "WandbLogger":
            import wandb

            wandb.finish()


def _silence_lightning() -> None:
    for name in ("lightning.pytorch", "lightning.fabric", "lightning"):
        # Under Hydra each line would appear twice, once from Lightning's own handler.
        logging.getLogger(name).handlers.clear()
        logging.getLogger(name).setLevel(logging.WARNING)
    for message in HARMLESS:
        warnings.filterwarnings("ignore", message=message)


def log_test(trainer: L.Trainer, record: RunRecord, scores: dict[str, float]) -> None:
    """Log the test: metrics, and the settings that distinguish runs with the main scores.

    Args:
        trainer: its logger gets them, if it has one.
        record: of the run, with its metrics.
        scores: the metrics of every readout at the run's own size, for TensorBoard's HPARAMS.
    """
    logger = trainer.logger
    if logger is None:
        return
    if isinstance(logger, Board):
        logger.log_test(record, scores, trainer.global_step)
    else:
        logger.log_metrics(record.metrics, trainer.global_step)
        logger.log_hyperparams(_logged_settings(record.config))
    # Lightning closed it after the test; logging opened it again.
    logger.finalize("success")


def _logged_settings(config: dict[str, Any]) -> dict[str, Any]:
    """Return the settings that distinguish runs, with dotted keys."""
    keys = ("names", "sampler", "optimizer", "augment", "m", "learn", "seed", "batch_size")
    flat = {}
    for path, value in dotted({key: config[key] for key in keys}).items():
        _, _, name = path.rpartition(".")
        if not name.startswith("_"):
            flat[path] = value
    flat["max_epochs"] = config["trainer"]["max_epochs"]
    if config.get("tags"):
        flat["tags"] = ", ".join(config["tags"])
    return flat


def keep_freed_memory() -> None:
    """Make glibc reuse large blocks, which it maps and unmaps for every tensor by default.

    A training step allocates the same activations every time. Each page that is new from the system
    costs a fault and is zeroed first: for MOPS-Net at 32 clouds of 1,024 points that was 142,000
    faults and a quarter of the CPU time of a step (0.36 of 1.33 seconds, one core; 7,000 faults and
    0.03 seconds after this call). The process keeps its peak memory.
    """
    if not sys.platform.startswith("linux"):
        return
    with suppress(OSError, AttributeError):  # a C library without it, such as musl
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_MAX, 0)  # unless mmap is off, blocks above 32 MiB always use it
        mallopt(M_TRIM_THRESHOLD, 2**31 - 1)
        mallopt(M_TOP_PAD, 2**28)
