"""The logger of a run: building it, logging the test, ending it."""

from pathlib import Path
from typing import Any

import lightning as L
from lightning.pytorch.loggers import Logger
from omegaconf import DictConfig

from mops_lightning.config.build import build_as
from mops_lightning.records.run_record import RunRecord
from mops_lightning.training.run.board import Board
from mops_lightning.tree import dotted

LOGGER_FOLDERS = {"Board": "", "TensorBoardLogger": "", "CSVLogger": "csv"}
"""Subfolder of the run's folder that a logger writes to. TensorBoard calls a run by its folder."""

DISTINGUISHING = (
    "names",
    "sampler",
    "optimizer",
    "augment",
    "m",
    "learn",
    "seed",
    "batch_size",
)
"""Settings that are logged by a logger other than ``Board``."""


def build_logger(node: DictConfig, folder: Path, score: str) -> Any:
    """Build the logger, which writes into the run's folder itself unless it has a name."""
    offered = {"name": "", "score": score}
    _, _, class_name = node["_target_"].rpartition(".")
    if class_name in LOGGER_FOLDERS:
        offered["name"] = LOGGER_FOLDERS[class_name]
        offered["version"] = ""  # the progress bar would show a version
    unset = {name: value for name, value in offered.items() if name not in node}
    return build_as(Logger, node, "logger", unset, save_dir=str(folder))


def log_test(trainer: L.Trainer, record: RunRecord, scores: dict[str, float]) -> None:
    """Log the test: metrics, and the settings that distinguish runs with the main scores.

    Args:
        trainer: the trainer whose logger is used, if it has one.
        record: the run's record, with its metrics.
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
    chosen = {name: config[name] for name in DISTINGUISHING}
    flat = {}
    for path, value in dotted(chosen).items():
        _, _, name = path.rpartition(".")
        if not name.startswith("_"):
            flat[path] = value
    flat["max_epochs"] = config["trainer"]["max_epochs"]
    if config.get("tags"):
        flat["tags"] = ", ".join(config["tags"])
    return flat


def finish_loggers(trainer: L.Trainer) -> None:
    """End what a logger keeps open for its process: the next run of a sweep would continue it."""
    for logger in trainer.loggers:
        if type(logger).__name__ == "WandbLogger":
            import wandb

            wandb.finish()
