"""The only LightningModule: a sampler and a task net, of which one or both learn."""

from collections.abc import Callable, Mapping
from typing import Any, Literal, Protocol, get_args

import lightning as L
import torch
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler
from torchmetrics import MeanMetric, MetricCollection

from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.metrics import SET_METRICS
from mops_lightning.samplers.base import Sampler
from mops_lightning.scoring import FULL, BatchReadouts, Sample, full_cloud, readout_names
from mops_lightning.seeding import derive_seed
from mops_lightning.types import Batch, SampleOutput, TaskOutput

CHECKPOINT_KEY = "mops_lightning"
"""Where a checkpoint keeps the identity of its run."""

Learn = Literal["task", "sampler", "joint"]


class Task(Protocol):
    """What a task module offers; see ``tasks``."""

    score: str
    net: nn.Module

    def step(self, batch: Any, sample: Sample) -> TaskOutput:
        """Return losses, predictions and targets of one batch."""
        ...

    def metrics(self) -> MetricCollection:
        """Return new metrics that take predictions and targets."""
        ...


class Experiment(L.LightningModule):
    """Trains the sampler, the task net or both, and scores every readout.

    Args:
        task: an ``nn.Module`` that is a ``Task``.
        sampler: None only for ``learn="task"``, which does not use it.
        learn: what is trained. The rest is frozen: no gradients, evaluation mode.
        make_optimizer: from parameters to optimizer; not needed for testing only.
        make_schedule: from (optimizer, total_steps) to a per-step schedule.
        baselines: index samplers that are tested beside the sampler, by name.
        seed: what happens in step i of epoch e depends on (seed, e, i) only.
        identity: kept in checkpoints, so that none is resumed under other settings.

    Raises:
        UserError: ``learn`` is unknown, or the sampler that it needs is missing.
    """

    def __init__(
        self,
        task: nn.Module,
        sampler: Sampler | None = None,
        learn: Learn = "sampler",
        make_optimizer: Callable[..., Optimizer] | None = None,
        make_schedule: Callable[..., LRScheduler] | None = None,
        baselines: Mapping[str, Sampler] | None = None,
        seed: int = 0,
        identity: dict[str, str] | None = None,
    ) -> None:
        super().__init__()
        allowed = get_args(Learn)
        if learn not in allowed:
            raise UserError(f"learn: unknown value {learn!r}.{did_you_mean(learn, allowed)}")
        if sampler is None and learn != "task":
            raise UserError(f"learn={learn} needs a sampler; without one only learn=task works.")
        self.task: Any = task
        self.sampler = None if learn == "task" else sampler
        self.baselines = nn.ModuleDict({} if learn == "task" else dict(baselines or {}))
        self.learn = learn
        self.make_optimizer = make_optimizer
        self.make_schedule = make_schedule
        self.seed = seed
        self.identity = identity
        self.total_steps = 1
        for module in self._frozen():
            module.requires_grad_(False)
        self.own_readouts = readout_names(self.sampler)
        self.all_readouts = tuple(dict.fromkeys([*self.own_readouts, *self.baselines, FULL]))
        metrics: Any = task.metrics
        self.scores = nn.ModuleDict({name: metrics() for name in self.all_readouts})
        self.set_metrics = nn.ModuleDict(
            {name: MeanMetric(nan_strategy="disable") for name in SET_METRICS}
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
        if self.learn == "sampler":
            frozen.append(self.task)
        return frozen

    @property
    def trainable(self) -> bool:
        """Whether any parameter learns; an index sampler under a frozen net has none."""
        return any(p.requires_grad for p in self.parameters())

    def configure_optimizers(self) -> Any:
        """Build the optimizer of what learns, and its schedule over all steps of the run."""
        if self.make_optimizer is None:
            raise UserError("This experiment was built without an optimizer: it can only test.")
        optimizer = self.make_optimizer([p for p in self.parameters() if p.requires_grad])
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
        """Return the task loss plus the sampler's losses."""
        sampled: list[SampleOutput] = []

        def sample(points: Tensor) -> SampleOutput:
            sampled.append(full_cloud(points) if self.sampler is None else self.sampler(points))
            return sampled[-1]

        losses = dict(self.task.step(batch, sample).losses)
        for output in sampled:
            for name, value in output.losses.items():
                losses[name] = losses.get(name, 0) + value / len(sampled)
        total = torch.stack(list(losses.values())).sum()
        size = len(batch.points)
        for name, value in {**losses, "total": total}.items():
            self.log(f"train/loss/{name}", value.detach(), batch_size=size)
        self.log("loss", total.detach(), prog_bar=True, logger=False, batch_size=size)
        mean = total.detach()
        self.log("train/mean_loss", mean, on_step=False, on_epoch=True, batch_size=size)
        tau: Any = getattr(self.sampler, "tau", None)
        if tau is not None:
            self.log("train/tau", tau, batch_size=size)
        return total

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Score the learned readouts on held-out training clouds."""
        self._score(batch, "val", self.own_readouts)

    def test_step(self, batch: Batch, batch_idx: int) -> None:
        """Score the learned readouts, the baselines and the full clouds."""
        self._score(batch, "test", self.all_readouts)

    def _score(self, batch: Batch, stage: str, readouts: tuple[str, ...]) -> None:
        size = len(batch.points)
        baselines: Any = dict(self.baselines.items())
        batch_readouts = BatchReadouts(self.sampler, baselines)
        for readout in readouts:
            result = self.task.step(batch, batch_readouts.sample_as(readout))
            metrics: Any = self.scores[readout]
            metrics.update(result.predictions, result.targets)
            for name, metric in metrics.items(keep_base=True, copy_state=False):
                self.log(f"{stage}/{readout}/{name}", metric, batch_size=size)
            if readout == self.own_readouts[0]:
                for name, value in result.losses.items():
                    self.log(f"{stage}/loss/{name}", value, batch_size=size)
        for points, output in batch_readouts.outputs.values():
            for name, per_cloud in SET_METRICS.items():
                values = per_cloud(points, output)
                if values is not None:
                    mean: Any = self.set_metrics[name]
                    mean.update(values)
                    self.log(f"{stage}/{name}", mean, batch_size=size)
