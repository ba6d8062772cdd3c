"""The only LightningModule: trains a sampler, a task net or both, and scores every readout.

Per batch: loader, ``sampler.sample_sizes``, ``readouts``, ``task.step``, losses and metrics.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import GradientAccumulationScheduler, StochasticWeightAveraging
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from mops_lightning.config.settings import Learn
from mops_lightning.errors import UserError
from mops_lightning.ops.precision import full_precision, restrict_autocast_to_pointwise
from mops_lightning.records.readout_names import FULL, PROJECTED, size_prefix
from mops_lightning.samplers.base import Sampler
from mops_lightning.seeding import derive_seed
from mops_lightning.tasks.base import Task
from mops_lightning.training.checkpoint import CHECKPOINT_KEY, SAVED, THREADS, check_finite
from mops_lightning.training.readouts import names_of_readouts, readouts
from mops_lightning.training.recipe.distillation import Distillation, Targets
from mops_lightning.training.recipe.recipe import Recipe, draw_points, straight_through
from mops_lightning.training.scores import Scores
from mops_lightning.types import Batch, SampleOutput

TEST = "test/"
"""Prefix of the metrics of the test."""
VALIDATION = "val/"
"""Prefix of the metrics of a validation."""

ALL_POINTS = 0
"""The size of a step that trains the task net alone, without sampling."""


class Experiment(L.LightningModule):
    """Trains the sampler, the task net or both, and scores every readout.

    Args:
        task: see ``tasks``.
        sampler: None only for ``learn="task"``, which does not use it.
        learn: what is trained. The rest is frozen: no gradients, evaluation mode.
        make_optimizer: makes an optimizer from groups of parameters; a test needs none.
        make_schedule: makes a schedule per step from ``(optimizer, total_steps)``.
        baselines: index samplers to test for comparison, by name.
        seed: what happens in step i of epoch e depends on (seed, e, i) only.
        identity: kept in checkpoints, so that none is resumed under other settings.
        sizes: how many points are tested, from one pass over the data; None: ``m`` alone. With
            several, the metrics are named ``test/m32/generated/accuracy`` and so on.
        recipe: how the sampler is trained beyond its own losses; None: by these alone.
        task_lr_scale: with ``learn="joint"``, the task net's learning rate over the sampler's.
        other_tasks: the task with further frozen nets, whose losses train the sampler, too.
        test_logger: False keeps test metrics from the loggers and from ``trainer.test``'s result;
            None: they go to a logger if there is one.
        m: the size that is validated and gives the run's score; None: the sampler's.

    Raises:
        UserError: task and sampler do not allow ``learn``.
    """

    def __init__(
        self,
        task: Task,
        sampler: Sampler | None = None,
        learn: Learn = "sampler",
        make_optimizer: Callable[..., Optimizer] | None = None,
        make_schedule: Callable[..., LRScheduler] | None = None,
        baselines: Mapping[str, Sampler] | None = None,
        seed: int = 0,
        identity: dict[str, str] | None = None,
        sizes: Sequence[int] | None = None,
        m: int | None = None,
        task_lr_scale: float = 1.0,
        recipe: Recipe | None = None,
        other_tasks: Sequence[Task] = (),
        test_logger: bool | None = None,
    ) -> None:
        super().__init__()
        if sampler is None and learn != "task":
            raise UserError(f"learn={learn} needs a sampler; only learn=task works without one.")
        if learn == "task":
            sampler = None
            baselines = {}
        self.task: Task = task
        self.sampler = sampler
        self.baselines = nn.ModuleDict(dict(baselines or {}))
        self.learn = learn
        self.make_optimizer = make_optimizer
        self.make_schedule = make_schedule
        self.seed = seed
        self.identity = identity
        self.task_lr_scale = task_lr_scale
        self.recipe = recipe or Recipe()
        self.other_tasks = nn.ModuleList(other_tasks)
        self.distillation: Distillation | None = None
        if learn == "sampler":
            self.distillation = Distillation([task, *other_tasks], self.recipe)
        self.total_steps = 1
        self.test_logger = test_logger
        for module in self._frozen():
            module.requires_grad_(False)
        self.m: int = m or _size_of(sampler)
        self.sizes = tuple(sizes or (self.m,))
        self.prefixes = dict.fromkeys(self.sizes, "")
        if len(self.sizes) > 1:
            self.prefixes = {size: size_prefix(size) for size in self.sizes}
        self.main_readout, *others = names_of_readouts(sampler)
        self.score_name = self._score_name()
        names = dict.fromkeys([self.main_readout, *others])
        names |= dict.fromkeys([*self.baselines, FULL])
        self.scores = Scores(task.metrics, names, self.prefixes.values())
        self.train_scores = task.metrics(training=True)
        self.train()

    def _score_name(self) -> str:
        """Return the log key of the run's score: of the main readout at the run's own size."""
        score = self.task.score
        if self.sampler is None and self.task.full_score:
            score = self.task.full_score
        prefix = self.prefixes.get(self.m, "")
        return f"{TEST}{prefix}{self.main_readout}/{score}"

    def train(self, mode: bool = True) -> "Experiment":
        """Set the mode of what learns; frozen parts stay in evaluation mode.

        In training mode, BatchNorm would update its statistics without gradients, too.
        """
        super().train(mode)
        for module in self._frozen():
            module.eval()
        return self

    @property
    def trainable(self) -> bool:
        """Whether any parameter learns; an index sampler under a frozen net has none."""
        return any(parameter.requires_grad for parameter in self.parameters())

    def _frozen(self) -> list[nn.Module]:
        frozen: list[nn.Module] = [*self.baselines.values(), *self.other_tasks]
        if self.learn in ("sampler", "nothing"):
            frozen.append(self.task)
        if self.learn == "nothing" and self.sampler is not None:
            frozen.append(self.sampler)
        return frozen

    def configure_optimizers(self) -> Any:
        """Build the optimizer of what learns, and its schedule over all steps of the run."""
        if self.make_optimizer is None:
            raise UserError("This experiment was built without an optimizer: it can only test.")
        optimizer = self.make_optimizer(self._learned())
        for group in optimizer.param_groups:
            if self.learn == "joint" and group["name"] == "task":
                group["lr"] *= self.task_lr_scale
        self.total_steps = int(self.trainer.estimated_stepping_batches)
        if self.make_schedule is None:
            return optimizer
        schedule = self.make_schedule(optimizer, total_steps=self.total_steps)
        per_step = {"scheduler": schedule, "interval": "step"}
        return {"optimizer": optimizer, "lr_scheduler": per_step}

    def _learned(self) -> list[dict[str, Any]]:
        """Return the parameters that learn as groups of an optimizer, by module."""
        modules = {"sampler": self.sampler, "task": self.task}
        groups: list[dict[str, Any]] = []
        for name, module in modules.items():
            if module is None:
                continue
            learned = [parameter for parameter in module.parameters() if parameter.requires_grad]
            if learned:
                groups.append({"params": learned, "name": name})
        return groups

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add identity and threads; refuse a state that would replace the last finite one."""
        saved = {name: checkpoint.get(name) for name in SAVED}
        check_finite(saved, self.global_step, self.trainer.strategy)
        checkpoint[CHECKPOINT_KEY] = self.identity or {}
        checkpoint[THREADS] = torch.get_num_threads()

    def on_train_start(self) -> None:
        """Set the loader to where a resumed run continues, which may be inside an epoch.

        Lightning 2.6 restores a loader's state only in some cases, and does not call
        ``on_train_epoch_start`` for an epoch that had begun. From a checkpoint written after the
        last step of an epoch and before its end, it counts this epoch as completed and does not
        begin the next one: every later checkpoint would be one epoch behind.
        """
        epochs: Any = self.trainer.fit_loop.epoch_progress.current
        if epochs.processed == epochs.ready:
            self.trainer.fit_loop.reset_restart_stage()
        if self.trainer.fit_loop.restarted_mid_epoch:
            self._begin_epoch_of_callbacks()
        loader: Any = self.trainer.train_dataloader
        if self.distillation is not None:
            self.distillation.start(loader, self.device, _dtype(self))
        if hasattr(loader, "load_state_dict"):
            position = self.trainer.fit_loop.epoch_loop.batch_progress.current.ready
            if position >= len(loader):
                position = 0
            loader.load_state_dict({"epoch": self.current_epoch, "position": position})

    def _begin_epoch_of_callbacks(self) -> None:
        """Let callbacks of Lightning do again what they did at the start of the epoch.

        These do not save it in the checkpoint, and may do it twice.
        """
        trainer: Any = self.trainer  # its callbacks are not declared
        for callback in trainer.callbacks:
            if isinstance(callback, GradientAccumulationScheduler | StochasticWeightAveraging):
                callback.on_train_epoch_start(self.trainer, self)

    def on_train_epoch_start(self) -> None:
        """Tell the loader which epoch it is; the run may have been resumed."""
        loader: Any = self.trainer.train_dataloader
        if hasattr(loader, "set_epoch"):
            loader.set_epoch(self.current_epoch)

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        """Seed dropout and the like by (seed, epoch, step), and set the temperatures."""
        torch.manual_seed(derive_seed(self.seed, self.current_epoch, batch_idx))
        for module in self.modules():  # a task net may have samplers, too
            if isinstance(module, Sampler):
                module.anneal(self._progress)

    @property
    def _progress(self) -> float:
        """Share of the training steps before this one."""
        return self.global_step / max(self.total_steps - 1, 1)

    def _sample(self, points: Tensor, sizes: Sequence[int]) -> dict[int, SampleOutput]:
        """Sample at all sizes; without a sampler, the task net is given all points."""
        if self.sampler is None:
            return {m: SampleOutput(points, None, {}) for m in sizes}
        return self.sampler.sample_sizes(points, sizes)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Return the task loss plus the sampler's losses, over all sizes of this step.

        Raises:
            Diverged: a loss is NaN or infinite.
        """
        sizes: Sequence[int] = (ALL_POINTS,)
        if self.sampler is not None:
            sizes = self.sampler.training_sizes()
        rank = self.global_rank
        if rank:  # processes draw the same sizes, but different random numbers
            torch.manual_seed(derive_seed(self.seed, self.current_epoch, batch_idx, rank))
        with restrict_autocast_to_pointwise(self.device.type):
            available = batch.points.shape[1]
            n = self.recipe.points_at(self._progress, available, max(sizes))
            seen = draw_points(batch, n)
            targets = None
            if self.distillation is not None:
                targets = self.distillation.targets(batch, seen)
            outputs = self._sample(seen, sizes)
            terms: dict[str, list[Tensor]] = defaultdict(list)
            for m in sizes:
                losses_of_size = self._losses(batch, seen, outputs[m], targets)
                for name, value in losses_of_size.items():
                    terms[name].append(value)
            losses = self._over_sizes(terms, len(sizes))
            total = torch.stack(list(losses.values())).sum()
        check_finite({"the loss": total}, self.global_step, self.trainer.strategy)
        readout = self.main_readout
        if outputs[sizes[0]].soft_projected is not None:
            readout = PROJECTED
        logged = {**losses, "total": total}
        self._log_training(logged, readout, len(batch.points))
        return total

    def _over_sizes(self, terms: Mapping[str, list[Tensor]], sizes: int) -> dict[str, Tensor]:
        """Return the sum of each loss term over the step's sizes, or its mean.

        Args:
            terms: the values of every term; a sampler may have one at some sizes only.
            sizes: their number.
        """
        share = 1.0
        if self.sampler is not None and self.sampler.size_reduction == "mean":
            share = 1 / sizes
        losses = {}
        for name, values in terms.items():
            losses[name] = torch.stack(values).sum() * share
        return losses

    def _losses(
        self, batch: Batch, seen: Tensor, sampled: SampleOutput, targets: Targets | None
    ) -> dict[str, Tensor]:
        """Return the loss terms at one size: the task's, distillation and the sampler's own.

        The first two are means over the step's task nets. The task's target is the whole batch,
        also where the sampler has seen a part of its points.
        """
        inputs = [sampled.points]
        if sampled.soft_projected is not None:
            inputs = [sampled.soft_projected]
        if self.recipe.sees_matched(self._progress):
            inputs.append(straight_through(sampled.points, seen))
        tasks: list[Any] = [self.task, *self.other_tasks]
        numbers = self._nets_of_step()
        terms: dict[str, Tensor] = {}
        for points, number in product(inputs, numbers):
            task = tasks[number]
            result = task.step(batch, points)
            if points is inputs[0] and task is self.task:
                self.train_scores.update(result.predictions, result.targets)
            losses = dict(result.losses)
            if self.distillation is not None and targets is not None:
                losses |= self.distillation.losses(number, points, result.output, targets)
            for name, value in losses.items():
                share = value / (len(inputs) * len(numbers))
                terms[name] = terms.get(name, 0) + share
        return {**terms, **self.task.sample_losses(batch, seen, sampled), **sampled.losses}

    def _nets_of_step(self) -> list[int]:
        """Return the numbers of the task nets of this step: 0 is the run's own."""
        others = len(self.other_tasks)
        drawn = self.recipe.nets_per_step
        if not drawn:
            return list(range(1 + others))
        rows = torch.randperm(others)[:drawn] + 1
        return [0, *rows.tolist()]

    def _log_training(self, losses: dict[str, Tensor], readout: str, clouds: int) -> None:
        for name, value in losses.items():
            self.log(f"train/loss/{name}", value.detach(), batch_size=clouds, sync_dist=True)
        total = losses["total"].detach()
        over_epoch: dict[str, Any] = {
            "on_step": False,
            "on_epoch": True,
            "batch_size": clouds,
        }
        self.log("loss", total, prog_bar=True, logger=False, batch_size=clouds)
        self.log("train/mean_loss", total, sync_dist=True, **over_epoch)
        tau: Any = getattr(self.sampler, "tau", None)  # not every sampler has a temperature
        if tau is not None:
            self.log("train/tau", tau, batch_size=clouds)
        for name, metric in self.train_scores.items(keep_base=True, copy_state=False):
            self.log(f"train/{readout}/{name}", metric, **over_epoch)

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Score the learned readouts on held-out training clouds, at one size."""
        with full_precision(self.device.type):
            outputs = self._sample(batch.points, (self.m,))
            samples = readouts(batch.points, outputs, self.sampler)[self.m]
            self._score(VALIDATION, batch, {"": samples})
            self._score_sets(VALIDATION, {self.m: ""}, batch.points, outputs)

    def test_step(self, batch: Batch, batch_idx: int) -> None:
        """Score the learned readouts and the baselines at every size, and the full clouds."""
        with full_precision(self.device.type):
            outputs = self._sample(batch.points, self.sizes)
            samples = readouts(batch.points, outputs, self.sampler)
            for name, baseline in self.baselines.items():
                assert isinstance(baseline, Sampler)
                sampled = baseline.sample_sizes(batch.points, self.sizes)
                for m, output in sampled.items():
                    samples[m].setdefault(name, output.points)
            sets = {prefix: samples[m] for m, prefix in self.prefixes.items()}
            # The same for all sizes; without a sampler, the full clouds are in it already.
            of_all_sizes = sets.get("", {})
            sets[""] = {**of_all_sizes, FULL: batch.points}
            self._score(TEST, batch, sets)
            self._score_sets(TEST, self.prefixes, batch.points, outputs)

    def _score(self, stage: str, batch: Batch, sets: Mapping[str, Mapping[str, Tensor]]) -> None:
        """Update and log the task's metrics of readouts, and the loss of the main one.

        Args:
            stage: prefix of all log keys.
            batch: the clouds.
            sets: points by readout, by prefix of a size.
        """
        clouds = len(batch.points)
        logged: dict[str, Any] = {"batch_size": clouds, "logger": self._logs(stage)}
        samples: dict[tuple[str, str], Tensor] = {}
        for prefix, by_readout in sets.items():
            for readout, points in by_readout.items():
                samples[prefix, readout] = points
        results = self.task.scores(batch, samples)
        for (prefix, readout), result in results.items():
            updated = self.scores.update_readout(f"{prefix}{readout}", result)
            for name, metric in updated.items():
                self.log(f"{stage}{name}", metric, **logged)
            if readout != self.main_readout:
                continue
            for name, value in result.losses.items():
                key = f"{stage}{prefix}loss/{name}"
                mean = self.scores.update_loss(key, value, clouds)
                attribute = f"scores.losses.{key}"
                self.log(key, mean, metric_attribute=attribute, **logged)

    def _logs(self, stage: str) -> bool | None:
        """Return whether the metrics of a stage go to the loggers; None: if there is one."""
        if stage == TEST:
            return self.test_logger
        return None

    def _score_sets(
        self,
        stage: str,
        prefixes: Mapping[int, str],
        points: Tensor,
        outputs: Mapping[int, SampleOutput],
    ) -> None:
        """Update and log the metrics of the sampled sets themselves."""
        if self.sampler is None:
            return
        logs = self._logs(stage)
        clouds = len(points)
        updated = self.scores.update_sets(points, outputs, self.sampler.nested, prefixes)
        for name, metric in updated.items():
            self.log(f"{stage}{name}", metric, batch_size=clouds, logger=logs)


def _size_of(sampler: Sampler | None) -> int:
    if sampler is None:
        return 0
    return sampler.m


def _dtype(module: nn.Module) -> torch.dtype:
    """Return the type of a module's weights, which ``trainer.precision=bf16-true`` lowers."""
    for parameter in module.parameters():
        if parameter.is_floating_point():
            return parameter.dtype
    return torch.float32
