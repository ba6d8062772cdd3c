"""The only LightningModule: a sampler and a task net, of which one or both learn."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, get_args

import lightning as L
import torch
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler
from torchmetrics import MeanMetric

from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.metrics.sampled_set import SET_METRICS
from mops_lightning.ops.precision import full_precision, restrict_autocast_to_pointwise
from mops_lightning.records.readout_names import FULL, SOFT_PROJECTED, size_prefix
from mops_lightning.samplers.base import Sampler
from mops_lightning.seeding import derive_seed
from mops_lightning.tasks.base import Task
from mops_lightning.training.readouts import readout_names, readouts
from mops_lightning.types import Batch, SampleOutput

CHECKPOINT_KEY = "mops_lightning"
"""Where a checkpoint keeps the identity of its run."""

Learn = Literal["task", "sampler", "joint", "nothing"]


class Experiment(L.LightningModule):
    """Trains the sampler, the task net or both, and scores every readout.

    Args:
        task: see ``tasks``.
        sampler: None only for ``learn="task"``, which does not use it.
        learn: what is trained. The rest is frozen: no gradients, evaluation mode.
        make_optimizer: from parameters to optimizer; not needed for testing only.
        make_schedule: from (optimizer, total_steps) to a per-step schedule.
        baselines: index samplers that are tested beside the sampler, by name.
        seed: what happens in step i of epoch e depends on (seed, e, i) only.
        identity: kept in checkpoints, so that none is resumed under other settings.
        sizes: how many points are tested, from one pass over the data; None: ``m`` alone. With
            several, the metrics are named ``test/m32/generated/accuracy`` and so on.
        task_rate: with ``learn="joint"`` the task net's learning rate over that of the sampler.
        m: the size that is validated and whose score stands for the run; None: the sampler's.

    Raises:
        UserError: ``learn`` is unknown, the sampler that it needs is missing, or the task net lets
            no gradient through.
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
        task_rate: float = 1.0,
    ) -> None:
        super().__init__()
        allowed = get_args(Learn)
        if learn not in allowed:
            raise UserError(f"learn: unknown value {learn!r}.{did_you_mean(learn, allowed)}")
        if sampler is None and learn != "task":
            raise UserError(f"learn={learn} needs a sampler; without one only learn=task works.")
        learns = learn in ("task", "joint") or (sampler.learned and learn != "nothing")  # type: ignore[union-attr]
        if learns and not getattr(task.net, "differentiable", True):
            raise UserError(
                f"learn={learn}: {type(task.net).__name__} has no weights and lets no gradient "
                "through. Train under another task/net and test with evaluate=RUN, or choose a "
                "sampler that needs no training, such as sampler=fps."
            )
        self.task: Task = task
        self.sampler = None if learn == "task" else sampler
        self.baselines = nn.ModuleDict({} if learn == "task" else dict(baselines or {}))
        self.learn = learn
        self.make_optimizer = make_optimizer
        self.make_schedule = make_schedule
        self.seed = seed
        self.identity = identity
        self.task_rate = task_rate
        self.total_steps = 1
        for module in self._frozen():
            module.requires_grad_(False)
        self.m: int = m or (self.sampler.m if self.sampler is not None else 0)
        self.sizes = tuple(sizes or (self.m,))
        self.own_readouts = readout_names(self.sampler)
        score = task.full_score or task.score if self.sampler is None else task.score
        self.score_name = f"test/{self._prefix(self.m)}{self.own_readouts[0]}/{score}"
        readouts = dict.fromkeys([*self.own_readouts, *self.baselines])
        keys = [f"{self._prefix(size)}{name}" for size in self.sizes for name in readouts]
        make_metrics = task.metrics
        self.scores = nn.ModuleDict({key: make_metrics() for key in (*keys, *readouts, FULL)})
        self.train_scores = make_metrics(training=True)
        self.loss_means = nn.ModuleDict()  # the task says their names with its first result
        self.set_metrics = nn.ModuleDict(
            {
                f"{prefix}{name}": metric()
                for name, metric in SET_METRICS.items()
                for prefix in {"", *map(self._prefix, self.sizes)}
            }
        )
        self.train()

    def train(self, mode: bool = True) -> "Experiment":
        """Set training mode, but never for what is frozen: BatchNorm would go on learning."""
        super().train(mode)
        for module in self._frozen():
            module.eval()
        return self

    def _frozen(self) -> list[nn.Module]:
        frozen: list[nn.Module] = list(self.baselines.values())
        if self.learn in ("sampler", "nothing"):
            frozen.append(self.task)
        if self.learn == "nothing" and self.sampler is not None:
            frozen.append(self.sampler)
        return frozen

    @property
    def trainable(self) -> bool:
        """Whether any parameter learns; an index sampler under a frozen net has none."""
        return any(p.requires_grad for p in self.parameters())

    def configure_optimizers(self) -> Any:
        """Build the optimizer of what learns, and its schedule over all steps of the run."""
        if self.make_optimizer is None:
            raise UserError("This experiment was built without an optimizer: it can only test.")
        modules = [module for module in (self.sampler, self.task) if module is not None]
        groups = [[p for p in module.parameters() if p.requires_grad] for module in modules]
        optimizer = self.make_optimizer([{"params": group} for group in groups if group])
        if self.learn == "joint":
            optimizer.param_groups[-1]["lr"] *= self.task_rate
        self.total_steps = int(self.trainer.estimated_stepping_batches)
        if self.make_schedule is None:
            return optimizer
        schedule = self.make_schedule(optimizer, total_steps=self.total_steps)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep the run's identity beside its state."""
        checkpoint[CHECKPOINT_KEY] = self.identity or {}

    def on_train_start(self) -> None:
        """Put the loader where a resumed run goes on, which may be the middle of an epoch.

        Lightning 2.6 hands a loader its state only in some cases, and calls no
        ``on_train_epoch_start`` for an epoch that had begun.
        """
        loader: Any = self.trainer.train_dataloader
        if hasattr(loader, "load_state_dict"):
            begun = self.trainer.fit_loop.epoch_loop.batch_progress.current.ready
            position = begun if begun < len(loader) else 0
            loader.load_state_dict({"epoch": self.current_epoch, "position": position})

    def on_train_epoch_start(self) -> None:
        """Tell the loader which epoch it is; the run may have been resumed."""
        loader: Any = self.trainer.train_dataloader
        if hasattr(loader, "set_epoch"):
            loader.set_epoch(self.current_epoch)

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        """Seed dropout and the like by (seed, epoch, step), and set the temperature."""
        torch.manual_seed(derive_seed(self.seed, self.current_epoch, batch_idx))
        if self.sampler is not None:
            self.sampler.anneal(self.global_step / max(self.total_steps - 1, 1))

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Return the task loss plus the sampler's losses, over all sizes of this step."""
        with restrict_autocast_to_pointwise(self.device.type):
            return self._training_step(batch, batch_idx)

    def _training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        sizes = (0,) if self.sampler is None else self.sampler.training_sizes()
        if self.global_rank:  # sizes are everyone's, what is drawn for clouds each process's own
            torch.manual_seed(
                derive_seed(self.seed, self.current_epoch, batch_idx, self.global_rank)
            )
        outputs = {} if self.sampler is None else self.sampler.sample_sizes(batch.points, sizes)
        terms: dict[str, list[Tensor]] = defaultdict(list)
        for m in sizes:
            output = outputs.get(m) or SampleOutput(batch.points, None, {})
            soft = output.soft_projected
            result = self.task.step(batch, output.points if soft is None else soft)
            self.train_scores.update(result.predictions, result.targets)
            for name, value in (*result.losses.items(), *output.losses.items()):
                terms[name].append(value)
        share = 1.0
        if self.sampler is not None and self.sampler.size_reduction == "mean":
            share = 1 / len(sizes)
        losses = {name: torch.stack(values).sum() * share for name, values in terms.items()}
        total = torch.stack(list(losses.values())).sum()
        self._log_training(losses, total, soft is not None, len(batch.points))
        return total

    def _log_training(
        self, losses: dict[str, Tensor], total: Tensor, soft: bool, size: int
    ) -> None:
        for name, value in {**losses, "total": total}.items():
            self.log(f"train/loss/{name}", value.detach(), batch_size=size, sync_dist=True)
        self.log("loss", total.detach(), prog_bar=True, logger=False, batch_size=size)
        mean = total.detach()
        self.log(
            "train/mean_loss", mean, on_step=False, on_epoch=True, batch_size=size, sync_dist=True
        )
        tau: Any = getattr(self.sampler, "tau", None)
        if tau is not None:
            self.log("train/tau", tau, batch_size=size)
        seen = SOFT_PROJECTED if soft else self.own_readouts[0]
        for name, metric in self.train_scores.items(keep_base=True, copy_state=False):
            self.log(f"train/{seen}/{name}", metric, on_step=False, on_epoch=True, batch_size=size)

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Score the learned readouts on held-out training clouds, at one size."""
        with full_precision(self.device.type):
            outputs, samples = self._sampled(batch.points, (self.m,))
            own = samples[self.m] or {FULL: batch.points}
            self._score(batch, "val/", own, self.task.reference(batch))
            self._score_sets(batch.points, outputs, {self.m: "val/"})

    def test_step(self, batch: Batch, batch_idx: int) -> None:
        """Score the learned readouts and the baselines at every size, and the full clouds."""
        with full_precision(self.device.type):
            self._test_step(batch)

    def _test_step(self, batch: Batch) -> None:
        outputs, samples = self._sampled(batch.points, self.sizes)
        for name, baseline in self.baselines.items():
            sampler: Any = baseline
            for m, output in sampler.sample_sizes(batch.points, self.sizes).items():
                samples[m].setdefault(name, output.points)
        reference = self.task.reference(batch)
        prefixes = {m: f"test/{self._prefix(m)}" for m in self.sizes}
        for m, prefix in prefixes.items():
            self._score(batch, prefix, samples[m], reference)
        self._score(batch, "test/", {FULL: batch.points}, reference)
        self._score_sets(batch.points, outputs, prefixes)

    def _sampled(
        self, points: Tensor, sizes: Sequence[int]
    ) -> tuple[dict[int, SampleOutput], dict[int, dict[str, Tensor]]]:
        """Return the sampler's outputs and all their readouts, by size; empty without a sampler."""
        if self.sampler is None:
            return {}, {m: {} for m in sizes}
        outputs = self.sampler.sample_sizes(points, sizes)
        return outputs, readouts(points, outputs, self.sampler)

    def _prefix(self, m: int) -> str:
        return size_prefix(m) if len(self.sizes) > 1 else ""

    def _score(
        self, batch: Batch, prefix: str, samples: Mapping[str, Tensor], reference: Any
    ) -> None:
        """Update and log the metrics of readouts at one size; ``prefix`` is of stage and size."""
        size = len(batch.points)
        within = prefix.split("/", 1)[1]
        for readout, points in samples.items():
            result = self.task.scored(batch, points, reference)
            metrics: Any = self.scores[f"{within}{readout}"]
            metrics.update(result.predictions, result.targets)
            for name, metric in metrics.items(keep_base=True, copy_state=False):
                self.log(f"{prefix}{readout}/{name}", metric, batch_size=size)
            if readout == self.own_readouts[0]:
                for name, value in result.losses.items():
                    self._log_loss(f"{prefix}loss/{name}", value, size)

    def _log_loss(self, key: str, value: Tensor, size: int) -> None:
        """Log a mean over clouds that may be spread unevenly over processes."""
        if key not in self.loss_means:
            self.loss_means[key] = MeanMetric(nan_strategy="disable").to(self.device)
        mean: Any = self.loss_means[key]
        mean.update(value, size)
        self.log(key, mean, batch_size=size, metric_attribute=f"loss_means.{key}")

    def _score_sets(
        self, points: Tensor, outputs: dict[int, SampleOutput], prefixes: dict[int, str]
    ) -> None:
        """Update and log what is measured of the sampled sets themselves, at every size."""
        if self.sampler is None:
            return
        # Of a nested sampler the largest set is measured, for it contains the smaller ones.
        groups: dict[int, tuple[int, ...]] = {m: (m,) for m in outputs}
        if self.sampler.nested:
            groups = {max(outputs): tuple(outputs)}
        for largest, sizes in groups.items():
            for name, metric in SET_METRICS.items():
                for m, values in (metric.measure(points, outputs[largest], sizes) or {}).items():
                    mean: Any = self.set_metrics[f"{prefixes[m].split('/', 1)[1]}{name}"]
                    mean.update(values)
                    self.log(f"{prefixes[m]}{name}", mean, batch_size=len(points))
