"""Everything that a run needs before it trains, built and checked."""

from dataclasses import dataclass
from pathlib import Path

import lightning as L
from omegaconf import DictConfig

from mops_lightning.config import distributed
from mops_lightning.data.clouds import CloudDataset
from mops_lightning.errors import UserError
from mops_lightning.records.run_record import RunRecord
from mops_lightning.training import checkpoint
from mops_lightning.training.evaluation.trained_run import OF_RUN, TrainedRun
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.factory import make_experiment
from mops_lightning.training.loaders import held_out_mask
from mops_lightning.training.trainer import device_name, make_trainer


@dataclass(frozen=True)
class Job:
    """What the stages of one run share.

    Attributes:
        cfg: the composed configuration.
        folder: the run's folder.
        dataset: the loaded data.
        experiment: task, sampler and baselines.
        trainer: Lightning's.
        resumed: the checkpoint that training starts from; None starts at the beginning.
        trained: the run that is evaluated.
    """

    cfg: DictConfig
    folder: Path
    dataset: CloudDataset
    experiment: Experiment
    trainer: L.Trainer
    resumed: Path | None
    trained: TrainedRun | None

    @property
    def trains(self) -> bool:
        """Whether anything is trained."""
        return self.experiment.trainable and self.trained is None

    @property
    def has_task_weights(self) -> bool:
        """Whether the task net has weights; ICP has none."""
        return any(True for _ in self.experiment.task.parameters())

    @property
    def part(self) -> tuple[int, int]:
        """Rank of this process and number of processes."""
        return self.trainer.global_rank, self.trainer.world_size


def prepare(
    cfg: DictConfig,
    folder: Path,
    dataset: CloudDataset,
    record: RunRecord,
    trained: TrainedRun | None = None,
) -> Job:
    """Build all parts of a run, so that mistakes in settings end it before anything is trained.

    Raises:
        UserError: settings that do not fit each other, the data or the checkpoint to resume.
    """
    identity = checkpoint.identity(record.config, dataset.fingerprint)
    resumed = checkpoint.find(cfg, identity)
    record.dataset_fingerprint = dataset.fingerprint
    record.train_clouds, record.test_clouds = len(dataset.train.labels), len(dataset.test.labels)
    record.class_names = list(dataset.class_names)
    record.dataset_facts = dataset.notes
    record.resumed_from = None if resumed is None else str(resumed)
    record.lengthened = resumed is not None and checkpoint.lengthened(cfg, resumed)
    experiment = make_experiment(cfg, dataset, identity)
    trainer = make_trainer(cfg, folder, dataset, experiment)
    job = Job(cfg, folder, dataset, experiment, trainer, resumed, trained)
    distributed.check_shares(
        cfg.batch_size,
        len(dataset.test.labels),
        int(held_out_mask(dataset.train, cfg.val_fraction, cfg.seed).sum()),
        trainer.world_size,
    )
    if not job.has_task_weights and cfg.weights not in (None, "auto", OF_RUN):
        raise UserError(
            f"weights: {cfg.names.net} has no weights to load, got {cfg.weights}. "
            "Leave weights out."
        )
    learned = experiment.sampler is not None and experiment.sampler.learned
    if cfg.learn == "nothing" and learned and not cfg.evaluate:
        raise UserError("learn=nothing needs a trained sampler: give its run with evaluate=RUN.")
    record.device = device_name(trainer)
    return job
