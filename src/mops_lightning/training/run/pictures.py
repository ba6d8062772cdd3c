"""The callback that draws the same few test clouds during training and after the test."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import lightning as L
import numpy as np
import torch
from lightning.fabric.utilities import move_data_to_device
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import TensorBoardLogger
from matplotlib.figure import Figure
from PIL import Image
from torch import Tensor

from mops_lightning.channels import NO_CHANNELS, PointChannels, coordinates
from mops_lightning.data.clouds import CloudDataset
from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.metrics.info import MetricInfo
from mops_lightning.records.readout_names import FULL
from mops_lightning.tasks.base import Task, figures_of
from mops_lightning.training.readouts import readouts
from mops_lightning.training.run.board import Board
from mops_lightning.viz import figures as drawing

DENSE_PIXELS = 2**20
"""Most entries of S that are drawn: 1,024 points by 1,024 columns."""


class CloudVisualization(Callback):
    """Draws a fixed set of clouds with every readout, S with SᵀS, and the task's figures.

    They go to TensorBoard about ten times in a run and after the test, and as PNGs to the run's
    folder after the test, when the task's figures include the baselines.

    Args:
        batch: the test clouds to draw, as the task's ``step`` takes them.
        titles: one per cloud of the dataset.
        folder: the run's folder; PNGs go to ``pictures`` below it.
        up: the vertical axis of the clouds, ``x``, ``y`` or ``z``, as in
            ``Augmentation.rotate_up``; true and false mean y.
        colour: name of the channel that gives the colours of the clouds; None: each readout has
            its colour.
        channels: channels of the points.

    Raises:
        UserError: there is no such axis or channel.
    """

    def __init__(
        self,
        batch: Any,
        titles: Sequence[str],
        folder: Path,
        up: bool | str = "y",
        colour: str | None = None,
        channels: PointChannels = NO_CHANNELS,
    ) -> None:
        axis = "y"
        if not isinstance(up, bool):
            axis = up
        if axis not in drawing.VIEWS:
            raise UserError(f"up must be x, y or z (the vertical axis), got {up!r:.99}.")
        if colour is not None and not channels:
            raise UserError(
                f"colour: no channel {colour!r}: the points have x, y and z only. dataset.features "
                "gives them channels."
            )
        if colour is not None and colour not in channels.names:
            hint = did_you_mean(colour, channels.names)
            raise UserError(f"colour: no channel {colour!r}.{hint}")
        self.up = axis
        self.channel = None
        if colour is not None:
            self.channel = 3 + channels.names.index(colour)
        self.batch = batch
        self.titles = list(titles)
        self.folder = folder / "pictures"

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Draw into TensorBoard every tenth of the run."""
        every = max(_planned_epochs(trainer) // 10, 1)
        board = _board(trainer)
        if board is None or trainer.current_epoch % every != 0:
            return
        drawn = self._draw(trainer, pl_module, scores=None)
        for name, figure in drawn.figures.items():
            drawing.view_upright(figure, self.up)
            board.experiment.add_figure(_tag(name), figure, trainer.global_step)

    def on_test_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Draw into TensorBoard and as PNG."""
        if not trainer.is_global_zero:
            return
        board = _board(trainer)
        drawn = self._draw(trainer, pl_module, scores=trainer.callback_metrics)
        if drawn.samples:
            path = self.folder / drawing.CLOUDS
            points = drawing.to_y_up(drawn.points, self.up)
            samples = {}
            for name, sample in drawn.samples.items():
                samples[name] = drawing.to_y_up(sample, self.up)
            drawing.save_clouds(path, points, samples, drawn.titles)
            if isinstance(board, Board):
                board.add_clouds(points, samples, trainer.global_step)
        for name, figure in drawn.figures.items():
            drawing.view_upright(figure, self.up)
            path = self.folder / f"{name}.png"
            drawing.save_figure(figure, path)
            if board is not None:  # it shows the saved file: a second drawing takes as long
                pixels = np.asarray(Image.open(path).convert("RGB"))
                step = trainer.global_step
                board.experiment.add_image(_tag(name), pixels, step, dataformats="HWC")

    @torch.no_grad()
    def _draw(
        self,
        trainer: L.Trainer,
        module: Any,
        scores: Mapping[str, Tensor] | None,
    ) -> "_Drawn":
        """Draw the clouds with the nets as they are.

        Args:
            trainer: gives precision and device.
            module: the experiment.
            scores: test metrics by name; None before the test. Baselines do not change in
                training, so they are drawn once, with the scores.
        """
        training = module.training
        module.eval()
        converted = trainer.precision_plugin.convert_input(self.batch)
        batch = move_data_to_device(converted, module.device)
        titles = cloud_titles(module.task, self.titles)
        methods: dict[str, Tensor] = {}
        if scores is not None:
            for name, baseline in module.baselines.items():
                methods[name] = baseline(batch.points, module.m).points
        if module.sampler is None:
            methods[FULL] = batch.points
            figures = figures_of(module.task, batch, methods, self.titles)
            drawn = _Drawn(figures, coordinates(batch.points), {}, titles)
        else:
            drawn = self._with_sampler(module, batch, methods, scores)
        module.train(training)
        return drawn

    def _with_sampler(
        self,
        module: Any,
        batch: Any,
        methods: Mapping[str, Tensor],
        scores: Mapping[str, Tensor] | None,
    ) -> "_Drawn":
        """Draw the readouts of the sampler beside the samples of other methods."""
        points = batch.points
        m = module.m
        output = module.sampler(points, m)
        samples = readouts(points, {m: output}, module.sampler)[m]
        titles = cloud_titles(module.task, self.titles)
        figures = figures_of(module.task, batch, {**methods, **samples}, self.titles)
        figures["clouds"] = drawing.cloud_grid(points, samples, titles, self.channel)
        points = coordinates(points)
        samples = {name: coordinates(sample) for name, sample in samples.items()}
        if scores is not None:
            compared = {name: coordinates(sample) for name, sample in methods.items()}
            compared[module.main_readout] = samples[module.main_readout]
            figures["comparison"] = self._comparison(module, points, compared, scores)
        matrix = output.matrix
        if matrix is not None and points.shape[1] * matrix.m <= DENSE_PIXELS:
            first = matrix.first_cloud()
            dense = first.dense()[0]
            gram = first.gram()[0]
            figures["matrix"] = drawing.matrix_figure(dense, gram, titles[0])
        return _Drawn(figures, points, samples, titles)

    def _comparison(
        self,
        module: Any,
        points: Tensor,
        samples: Mapping[str, Tensor],
        scores: Mapping[str, Tensor],
    ) -> Figure:
        """Draw one cloud with the sample of each method, under the method's test score."""
        cloud = (len(self.titles) - 1) // 2
        metrics = module.task.metrics()
        info = MetricInfo.of(module.task.score, metrics[module.task.score])
        labels = {module.main_readout: type(module.sampler).__name__, FULL: "all points"}
        prefixes: dict[str, str] = dict.fromkeys(samples, module.prefixes[module.m])
        prefixes[FULL] = ""
        captions: dict[str, str] = {}
        for name, prefix in prefixes.items():
            captions[name] = labels.get(name, name)
            score = scores.get(f"test/{prefix}{name}/{info.name}")
            if score is not None:
                figure = info.format(float(score))
                captions[name] += f": {figure} {info.unit}"
        drawn = {name: sample[cloud] for name, sample in samples.items()}
        return drawing.comparison(points[cloud], drawn, captions)


class _Drawn(NamedTuple):
    """Figures, and the clouds that they show.

    Attributes:
        figures: by name.
        points: ``(K, N, 3)`` the clouds.
        samples: the coordinates of the sampler's readouts; empty without a sampler.
        titles: one per cloud.
    """

    figures: dict[str, Figure]
    points: Tensor
    samples: dict[str, Tensor]
    titles: list[str]


def _planned_epochs(trainer: L.Trainer) -> int:
    """Return the epochs of a whole training, also where ``trainer.max_steps`` says its length."""
    steps_of_epoch = math.ceil(trainer.num_training_batches / trainer.accumulate_grad_batches)
    return int(trainer.estimated_stepping_batches) // max(steps_of_epoch, 1)


def _board(trainer: L.Trainer) -> TensorBoardLogger | None:
    """Return the logger that shows pictures, in the process that writes them."""
    logger = trainer.logger
    if trainer.is_global_zero and isinstance(logger, TensorBoardLogger):
        return logger
    return None


def _tag(name: str) -> str:
    return f"pictures/{name}"  # a group behind the curves


def cloud_titles(task: Task, titles: Sequence[str]) -> list[str]:
    """Return one title per cloud of a batch, from one per cloud of the data."""
    if task.clouds_per_prediction == 1:
        return list(titles)
    doubled = [f"{title}_source" for title in titles]
    doubled += [f"{title}_target" for title in titles]
    return doubled


def clouds_to_draw(dataset: CloudDataset, number: int) -> tuple[Tensor, list[str]]:
    """Choose test clouds, spread over all classes and, of one class, over all its clouds.

    Clouds of one file are next to each other, so that clouds of several files are chosen.

    Returns:
        Rows of the test split, at most ``number``, and their titles: the names of their classes,
        counted where a class has several clouds.
    """
    labels = dataset.test.labels
    classes = len(dataset.class_names)
    candidates = _spread(classes, max(number, 1))
    candidates_in_test = [label for label in candidates.tolist() if label in labels]
    present = candidates_in_test[:number]
    rows: list[int] = []
    titles: list[str] = []
    for position, label in enumerate(present):
        share = number // len(present)
        if position < number % len(present):
            share += 1
        members = (labels == label).nonzero()[:, 0]
        rows_of_class = members[_spread(len(members), share)].tolist()
        rows += rows_of_class
        name = dataset.class_names[label]
        if len(rows_of_class) == 1:
            titles.append(name)
        else:
            numbers = range(1, len(rows_of_class) + 1)
            titles += [f"{name} {count}" for count in numbers]
    return torch.tensor(rows, dtype=torch.int64), titles


def _spread(available: int, number: int) -> Tensor:
    """Return at most ``number`` different rows of ``available`` ones, spread over all."""
    rows = torch.linspace(0, available - 1, min(number, available))
    return rows.round().long().unique()
