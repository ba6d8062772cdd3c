"""The parts of a run, built so that mistakes in settings end it before anything is trained.

Besides the settings of its node, a constructor is offered these values, by argument name:

| argument | of | value |
|---|---|---|
| ``num_classes`` | task, task net | number of classes of the data |
| ``num_parts`` | task, task net | number of parts that the points of the data belong to |
| ``net`` | task, samplers, baselines | the task net |
| ``point_channels`` | task, task net, sampler | channels of the points, see ``channels`` |
| ``seed`` | baselines | the run's seed, unless the node sets one |
| ``m`` | baselines, untrained samplers | the largest tested size |
| ``folder``, ``checkpoint`` | callbacks | the run's folder, its checkpoint |
| ``score`` | callbacks | name of the task's score |
| ``batch``, ``titles`` | callbacks | the pictured test clouds and their classes |
| ``channels`` | callbacks | channels of the pictured clouds |
| ``name``, ``save_dir`` | loggers | empty, the run's folder |
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import lightning as L
import torch
from omegaconf import DictConfig
from torch import Tensor, nn

from mops_lightning.channels import PointChannels
from mops_lightning.config import distributed, settings
from mops_lightning.config.build import build_as, takes
from mops_lightning.config.declaration import Training
from mops_lightning.config.shortened import UNLIMITED
from mops_lightning.data.clouds import CloudDataset, Clouds, check_parts
from mops_lightning.data.loader import Augmentation, CloudLoader
from mops_lightning.errors import UserError
from mops_lightning.records.run_record import RunRecord
from mops_lightning.samplers.base import Sampler
from mops_lightning.seeding import derive_seed, generator
from mops_lightning.tasks.base import Task
from mops_lightning.training import checkpoint
from mops_lightning.training.evaluation import OF_RUN, TrainedRun
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.recipe.recipe import Recipe
from mops_lightning.training.run.channels import check_sampler, check_without_channels
from mops_lightning.training.run.optimizers import OptimizerMakers, check_optimizers
from mops_lightning.training.run.other_nets import other_tasks
from mops_lightning.training.run.sizes import check_processes, smallest_cloud
from mops_lightning.training.run.trainer import make_trainer

STANDARD = (8, 16, 32, 64, 128, 256, 512)
"""The sizes of the paper's tables."""
AUTO = "auto"
MORE_POINTS = (
    "Lower it, or give clouds of more points (dataset.n_points; for pairs also task.resample)."
)


def has_weights(module: nn.Module) -> bool:
    """Return whether a module has weights."""
    return any(True for _ in module.parameters())


@dataclass(frozen=True)
class Parts:
    """The parts of one run, which its stages share.

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
        own = self.folder / "checkpoints" / checkpoint.CHECKPOINT
        if own.is_file():
            return own
        return self.resumed.path if self.resumed else None

    @property
    def part(self) -> tuple[int, int]:
        """Rank of this process and number of processes."""
        return self.trainer.global_rank, self.trainer.world_size

    def train_loader(self) -> CloudLoader:
        """Return a loader of the clouds to train on, augmented, in a new order in every epoch."""
        overfits = self.cfg.trainer.get("overfit_batches")
        return CloudLoader(
            self.train,
            self.cfg.batch_size,
            shuffle=not overfits,  # the same first batches in every epoch
            augment=augmentation(self.cfg),
            make_batch=self.experiment.task.make_batch,
            drop_last=True,
            seed=self.cfg.seed,
            channels=self.dataset.channels,
            part=self.part,
        )

    def score_loader(self, clouds: Clouds) -> CloudLoader:
        """Return a loader whose batches are the same in every epoch and for every sampler."""
        make_batch = self.experiment.task.make_batch
        return CloudLoader(clouds, self.cfg.batch_size, make_batch=make_batch, part=self.part)


def build_parts(
    cfg: DictConfig,
    folder: Path,
    dataset: CloudDataset,
    record: RunRecord,
    trained: TrainedRun | None = None,
) -> Parts:
    """Build all parts of a run, so that mistakes in settings end it before anything is trained.

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
    validated = len(held_out.labels) if parts.trains else 0
    tested = len(dataset.test.labels)
    check_processes(dataset, trainer.world_size)
    distributed.check_shares(cfg.batch_size, tested, validated, trainer.world_size)
    _check_weights(parts)
    record.device = _device_name(trainer)
    return parts


def _note_data(dataset: CloudDataset, record: RunRecord) -> None:
    """Describe the data in the record."""
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
    if not parts.has_task_weights and cfg.weights not in (None, "auto", OF_RUN):
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
    is_longer = epochs > resumed.planned and UNLIMITED not in (epochs, resumed.planned)
    return is_longer and not resumed.ending.should_stop


def make_experiment(cfg: DictConfig, dataset: CloudDataset, identity: dict[str, str]) -> Experiment:
    """Build task, sampler and baselines.

    Args:
        cfg: a composed configuration.
        dataset: says how many classes and points there are.
        identity: see ``checkpoint_identity``.

    Raises:
        UserError: a setting that its part or the data do not allow.
    """
    L.seed_everything(derive_seed(cfg.seed, 0) % 2**32, verbose=False)
    task = _make_task(cfg, dataset)
    # Another seed: the sampler's initial weights must not depend on the task net's size.
    L.seed_everything(derive_seed(cfg.seed, 1) % 2**32, verbose=False)
    of_task = {"net": task.net}  # for samplers that select points by the task net's features
    of_sampler = {**of_task, "point_channels": dataset.channels}
    sampler: Sampler | None = None
    if cfg.learn != "task":
        sampler = build_as(Sampler, cfg.sampler, "sampler", of_sampler)
        check_sampler(sampler, dataset)
    cloud = smallest_cloud((dataset.test, dataset.train), task.make_batch)
    trains = cfg.learn != "nothing"
    sizes = sizes_to_test(cfg.sizes, cfg.m, sampler, cloud.shape[1], training=trains)
    baselines: dict[str, Sampler] = {}
    others: Sequence[Task] = ()
    if sampler is not None and sampler.learned:
        baselines = _make_baselines(cfg, max(sizes), of_task)
        _try_baselines(baselines, cloud)
        others = other_tasks(cfg, dataset)
    elif sampler is not None and sampler.flexible:
        sampler = build_as(Sampler, cfg.sampler, "sampler", of_sampler, m=max(sizes))
    check_optimizers(cfg)
    makers = OptimizerMakers.of(cfg.optimizer, "optimizer")
    recipe = build_as(Recipe, cfg.recipe, "recipe")
    return Experiment(
        task,
        sampler,
        learn=cfg.learn,
        make_optimizer=makers.optimizer,
        make_schedule=makers.schedule,
        baselines=baselines,
        seed=cfg.seed,
        identity=identity,
        sizes=sizes,
        m=cfg.m,
        task_lr_scale=cfg.task_lr_scale,
        other_tasks=others,
        test_logger=False,  # stages.test logs them, as one table
        recipe=_in_force(recipe, sampler, cfg.learn),
    )


def _make_task(cfg: DictConfig, dataset: CloudDataset) -> Task:
    """Build the task and its net for the classes or parts of the data.

    Raises:
        UserError: net, task and data do not fit each other.
    """
    offered = {
        "num_classes": len(dataset.class_names),
        "num_parts": len(dataset.part_names),
    }
    _check_fits(cfg, dataset, offered)
    if not takes(cfg.task.net, "point_channels"):
        check_without_channels(f"task/net={cfg.names.net}", dataset)
    return build_task(cfg, offered, dataset.channels)


def build_task(cfg: DictConfig, outputs: Mapping[str, int], channels: PointChannels) -> Task:
    """Build a task and its net, without weights.

    Args:
        cfg: a composed configuration.
        outputs: ``num_classes`` and ``num_parts``.
        channels: of the points.

    Raises:
        UserError: a setting that the task or its net does not allow.
    """
    of_data: dict[str, Any] = {**outputs, "point_channels": channels}
    net = build_as(nn.Module, cfg.task.net, "task.net", of_data)
    task: Task = build_as(Task, cfg.task, "task", of_data, net=net)
    return task


def _check_fits(cfg: DictConfig, dataset: CloudDataset, offered: Mapping[str, int]) -> None:
    """Refuse a net of another task, and data without the parts that a task needs.

    Raises:
        UserError: net, task and data do not fit each other.
    """
    of_task = [name for name in offered if takes(cfg.task, name)]
    of_net = [name for name in offered if takes(cfg.task.net, name)]
    is_of_other_task = of_task and of_net and not set(of_task) & set(of_net)
    if is_of_other_task:
        raise UserError(
            f"task/net={cfg.names.net} takes {', '.join(of_net)}, but task={cfg.names.task} gives "
            f"{', '.join(of_task)}. Choose a net of this task (docs/tasks.md)."
        )
    if "num_parts" not in of_task:
        return
    if cfg.test_corruption and dataset.test.parts is None:
        raise UserError(
            f"test_corruption={cfg.test_corruption} adds or removes points, whose parts nobody "
            "knows. Give jitter, rotation, scaling, shear or distortion."
        )
    check_parts(dataset)


def augmentation(cfg: DictConfig) -> Augmentation:
    """Return the augmentation of this run; joint training has the sampler's."""
    of = "task" if cfg.learn == "task" else "sampler"
    return Augmentation(**(cfg.augment[of] or {}))


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
    number = round(len(names) * fraction)
    is_held_out = torch.isin(sources, names[order[:number]])
    return clouds.take(~is_held_out), clouds.take(is_held_out)


def sizes_to_test(
    sizes: str | Sequence[int],
    m: int,
    sampler: Sampler | None,
    n_points: int,
    training: bool = True,
) -> tuple[int, ...]:
    """Return the sizes that are tested, in ascending order.

    Args:
        sizes: ``auto`` tests a flexible learned sampler at those standard sizes that it and the
            clouds allow, any other sampler at ``m`` alone. A list is used as given.
        m: the run's own size, which is always tested.
        sampler: None where only the task net learns.
        n_points: N of the test clouds.
        training: whether the sampler is trained, which includes its largest size.

    Raises:
        UserError: the sampler or the clouds do not allow a size.
    """
    if sampler is None:
        return ()
    if sizes == AUTO:
        _check_largest({"m": m}, sampler, n_points, training)
        return _usual_sizes(m, sampler, n_points)
    listed = [int(size) for size in sizes]
    wanted = tuple(sorted({m, *listed}))
    if not sampler.flexible and wanted != (m,):
        raise UserError(
            f"sizes: this sampler returns {m} points only, got sizes={listed}. "
            "Train one that returns any number, such as sampler=fmops, or run with -m m=8,16,32."
        )
    _check_largest({"m": m, "sizes": wanted[-1]}, sampler, n_points, training)
    return wanted


def _usual_sizes(m: int, sampler: Sampler, n_points: int) -> tuple[int, ...]:
    """Return ``m``, and the standard sizes that a multi-size sampler and the clouds allow."""
    if not (sampler.flexible and sampler.learned):
        return (m,)
    most = min(sampler.m, n_points)
    standard = [size for size in STANDARD if size <= most]
    return tuple(sorted({m, *standard}))


def _check_largest(
    largest: Mapping[str, int], sampler: Sampler, n_points: int, training: bool
) -> None:
    """Refuse sizes that the sampler or the clouds do not allow.

    Args:
        largest: the largest size that a setting requests, by its name.
        sampler: the sampler.
        n_points: N of the test clouds.
        training: whether the sampler is trained, which includes its largest size.

    Raises:
        UserError: a size is too large.
    """
    requested = dict(largest)
    if sampler.learned and training:
        requested["sampler.m_max"] = sampler.m
    for name, size in requested.items():
        if size > n_points:
            raise UserError(
                f"{name} must be at most the {n_points} points of a cloud, got {size}. "
                f"{MORE_POINTS}"
            )
        if sampler.learned and size > sampler.m:
            raise UserError(
                f"{name} must be at most sampler.m_max={sampler.m}, got {size}. "
                f"Lower it, or train with sampler.m_max={size}."
            )


def _in_force(recipe: Recipe, sampler: Sampler | None, learn: str) -> Recipe:
    """Return the part of a recipe that counts; the task net's training has its own record."""
    if sampler is None:
        return Recipe(task_points=recipe.task_points)
    if sampler.learned:
        return replace(recipe, task_points=None)
    if learn != "joint":
        return Recipe()
    # A task net that is trained on the sampler's points sees as many clouds as with a learned one.
    kept = {}
    for name, value in asdict(recipe).items():
        if settings.of(f"recipe.{name}").is_of(Training.JOINT):
            kept[name] = value
    return Recipe(**kept)


def _make_baselines(cfg: DictConfig, m: int, of_task: Mapping[str, Any]) -> dict[str, Sampler]:
    """Build the index samplers for ``m`` points, with the run's seed unless they have their own."""
    baselines: dict[str, Sampler] = {}
    for name, node in cfg.baselines.items():
        if not node:
            continue
        offered = dict(of_task)
        if "seed" not in node:
            offered["seed"] = cfg.seed
        baselines[str(name)] = build_as(Sampler, node, f"baselines.{name}", offered, m=m)
    return baselines


@torch.no_grad()
def _try_baselines(baselines: dict[str, Sampler], points: Tensor) -> None:
    """Sample one cloud, so that a mistake ends the run before its training, not in its test."""
    for name, baseline in baselines.items():
        try:
            baseline.eval()(points)
        except UserError as error:
            raise UserError(f"baselines.{name}: {error}") from None
