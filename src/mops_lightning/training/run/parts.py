"""The parts of a run, with the loaders of its data."""

from dataclasses import dataclass
from pathlib import Path

import lightning as L
from omegaconf import DictConfig
from torch import nn

from mops_lightning.data.clouds import CloudDataset, Clouds
from mops_lightning.data.loader import Augmentation, CloudLoader
from mops_lightning.training import checkpoint
from mops_lightning.training.evaluation import TrainedRun
from mops_lightning.training.experiment import Experiment


@dataclass(frozen=True)
class Parts:
    """Everything that the stages of one run share.

    Attributes:
        cfg: the composed configuration.
        folder: the run's folder.
        dataset: the loaded data.
        train: the clouds to train on.
        held_out: the training clouds for the curves under ``val/``.
        experiment: task, sampler and baselines.
        trainer: Lightning's.
        resumed: the checkpoint that training starts from; None starts at the beginning.
        trained: the run that is evaluated.
    """

    cfg: DictConfig
    folder: Path
    dataset: CloudDataset
    train: Clouds
    held_out: Clouds
    experiment: Experiment
    trainer: L.Trainer
    resumed: checkpoint.Checkpoint | None
    trained: TrainedRun | None

    @property
    def trains(self) -> bool:
        """Whether anything is trained."""
        return self.experiment.trainable and self.trained is None

    @property
    def has_task_weights(self) -> bool:
        """Whether the task net has weights."""
        return has_weights(self.experiment.task)

    @property
    def last_checkpoint(self) -> Path | None:
        """The newest checkpoint of this run, or the one that it was resumed from."""
        written = self.folder / "checkpoints" / checkpoint.CHECKPOINT
        if written.is_file():
            return written
        if self.resumed is None:
            return None
        return self.resumed.path

    @property
    def rank_of_processes(self) -> tuple[int, int]:
        """Rank of this process and number of processes."""
        return self.trainer.global_rank, self.trainer.world_size

    def train_loader(self) -> CloudLoader:
        """Return a loader of the clouds to train on, augmented, in a new order in every epoch."""
        # overfit_batches trains on the same first batches in every epoch.
        is_shuffled = not self.cfg.trainer.get("overfit_batches")
        return CloudLoader(
            self.train,
            self.cfg.batch_size,
            shuffle=is_shuffled,
            augment=augmentation(self.cfg),
            make_batch=self.experiment.task.make_batch,
            drop_last=True,
            seed=self.cfg.seed,
            channels=self.dataset.channels,
            part=self.rank_of_processes,
        )

    def score_loader(self, clouds: Clouds) -> CloudLoader:
        """Return a loader whose batches are the same in every epoch and for every sampler."""
        return CloudLoader(
            clouds,
            self.cfg.batch_size,
            make_batch=self.experiment.task.make_batch,
            part=self.rank_of_processes,
        )


def has_weights(module: nn.Module) -> bool:
    """Return whether a module has weights."""
    return any(True for _ in module.parameters())


def augmentation(cfg: DictConfig) -> Augmentation:
    """Return the augmentation of this run; joint training has the sampler's."""
    settings = cfg.augment.sampler
    if cfg.learn == "task":
        settings = cfg.augment.task
    return Augmentation(**(settings or {}))
