"""Building the parts of a run, so that mistakes in settings end it before anything is trained."""

from pathlib import Path

import lightning as L
import torch
from omegaconf import DictConfig

from mops_lightning.config import distributed
from mops_lightning.config.shortened import UNLIMITED
from mops_lightning.data.clouds import CloudDataset, Clouds
from mops_lightning.errors import UserError
from mops_lightning.records.run_record import RunRecord
from mops_lightning.seeding import generator
from mops_lightning.training import checkpoint
from mops_lightning.training.evaluation import TrainedRun, names_a_net
from mops_lightning.training.run.cloud_sizes import check_processes
from mops_lightning.training.run.make_experiment import make_experiment
from mops_lightning.training.run.parts import Parts
from mops_lightning.training.run.trainer import make_trainer


def build_parts(
    cfg: DictConfig,
    folder: Path,
    dataset: CloudDataset,
    record: RunRecord,
    trained: TrainedRun | None = None,
) -> Parts:
    """Build all parts of a run.

    Args:
        cfg: the run's settings.
        folder: the run's folder.
        dataset: the loaded data.
        record: the run's record, which is filled with data, device and the resumed run.
        trained: the run that is evaluated.

    Raises:
        UserError: settings that do not fit each other, the data or the checkpoint to resume.
    """
    identity = checkpoint.checkpoint_identity(record.config, dataset.fingerprint)
    _note_data(dataset, record)
    resumed = None
    if cfg.ckpt_path is not None:
        resumed = checkpoint.find_checkpoint(cfg.ckpt_path, Path(cfg.out), identity)
        record.resumed_from = str(resumed.path)
        record.lengthened = _lengthens(resumed, cfg.trainer.max_epochs)
    train, held_out = split(dataset.train, cfg.val_fraction, cfg.seed)
    experiment = make_experiment(cfg, dataset, identity)
    trainer = make_trainer(cfg, folder, dataset, experiment, len(train.labels))
    parts = Parts(cfg, folder, dataset, train, held_out, experiment, trainer, resumed, trained)
    validated = 0
    if parts.trains:
        validated = len(held_out.labels)
    tested = len(dataset.test.labels)
    check_processes(dataset, trainer.world_size)
    distributed.check_shares(cfg.batch_size, tested, validated, trainer.world_size)
    _check_weights(parts)
    record.device = _device_name(trainer)
    return parts


def _note_data(dataset: CloudDataset, record: RunRecord) -> None:
    """Describe the data in a record."""
    record.dataset_fingerprint = dataset.fingerprint
    record.train_clouds = len(dataset.train.labels)
    record.test_clouds = len(dataset.test.labels)
    record.class_names = list(dataset.class_names)
    record.part_names = list(dataset.part_names)
    record.dataset_facts = dataset.notes


def _check_weights(parts: Parts) -> None:
    """Refuse weights for a task net without any, and a test of an untrained sampler.

    Raises:
        UserError: such a setting is given.
    """
    cfg = parts.cfg
    if not parts.has_task_weights and names_a_net(cfg.weights):
        raise UserError(
            f"weights: {cfg.names.net} has no weights to load, got {cfg.weights}. "
            "Give weights=null."
        )
    sampler = parts.experiment.sampler
    is_untrained = sampler is not None and sampler.learned and not cfg.evaluate
    if cfg.learn == "nothing" and is_untrained:
        raise UserError("learn=nothing needs a trained sampler: give its run with evaluate=RUN.")


def _device_name(trainer: L.Trainer) -> str:
    """Return the name of the GPU, or the kind of another device."""
    device = trainer.strategy.root_device
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return str(device.type)


def _lengthens(resumed: checkpoint.Checkpoint, epochs: int) -> bool:
    """Return whether more epochs are trained than were planned; not after early stopping."""
    if resumed.ending.should_stop:
        return False
    if UNLIMITED in (epochs, resumed.planned):
        return False
    return epochs > resumed.planned


def split(clouds: Clouds, fraction: float, seed: int) -> tuple[Clouds, Clouds]:
    """Hold out a random share of the training clouds for the curves under ``val/``.

    Clouds of one source, such as the crops of a file, are held out together.

    Returns:
        The clouds to train on and the held-out clouds, each in their original order.
    """
    sources = clouds.sources
    if sources is None:
        sources = torch.arange(len(clouds.labels))
    names = sources.unique()
    order = torch.randperm(len(names), generator=generator(seed, 2))
    held_out = names[order[: round(len(names) * fraction)]]
    is_held_out = torch.isin(sources, held_out)
    return clouds.take(~is_held_out), clouds.take(is_held_out)
