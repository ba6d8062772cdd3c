"""The callback that draws the same few test clouds during training and after the test."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from lightning.fabric.utilities import move_data_to_device
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import TensorBoardLogger
from matplotlib.figure import Figure
from PIL import Image
from torch import Tensor

from mops_lightning.data.clouds import CloudDataset
from mops_lightning.errors import UserError
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

    Raises:
        UserError: there is no such axis.
    """

    def __init__(
        self, batch: Any, titles: Sequence[str], folder: Path, up: bool | str = "y"
    ) -> None:
        axis = "y" if isinstance(up, bool) else up
        if axis not in drawing.AXES:
            raise UserError(f"up must be x, y or z (the vertical axis), got {up!r:.99}.")
        self.up = axis
        self.batch = batch
        self.titles = list(titles)
        self.folder = folder / "pictures"

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Draw into TensorBoard every tenth of the run."""
        every = max((trainer.max_epochs or 1) // 10, 1)
        if trainer.current_epoch % every == 0:
            self._draw(trainer, pl_module, None)

    def on_test_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Draw into TensorBoard and as PNG."""
        self._draw(trainer, pl_module, self.folder)

    def _draw(self, trainer: L.Trainer, module: L.LightningModule, folder: Path | None) -> None:
        """Draw with the nets as they are; PNGs and baselines only where there is a folder."""
        board = trainer.logger if isinstance(trainer.logger, TensorBoardLogger) else None
        if not trainer.is_global_zero or (board is None and folder is None):
            return
        training = module.training
        module.eval()
        converted = trainer.precision_plugin.convert_input(self.batch)
        batch = move_data_to_device(converted, module.device)
        scores = trainer.callback_metrics if folder is not None else None
        figures, samples = self._figures(module, batch, scores)
        module.train(training)
        task: Any = module.task
        titles = cloud_titles(task, self.titles)
        if folder is not None and samples:
            points = drawing.to_y_up(batch.points, self.up)
            turned = {name: drawing.to_y_up(sample, self.up) for name, sample in samples.items()}
            drawing.save_clouds(folder / drawing.CLOUDS, points, turned, titles)
            if isinstance(board, Board):
                board.add_clouds(points, turned, trainer.global_step)
        for name, figure in figures.items():
            drawing.view_upright(figure, self.up)
            path = folder and drawing.save_figure(figure, folder / f"{name}.png")
            if board is None:
                continue
            tag = f"pictures/{name}"  # a group behind the curves
            if path is None:
                board.experiment.add_figure(tag, figure, trainer.global_step)
            else:  # what was drawn already
                pixels = np.asarray(Image.open(path).convert("RGB"))
                board.experiment.add_image(tag, pixels, trainer.global_step, dataformats="HWC")

    @torch.no_grad()
    def _figures(
        self, module: Any, batch: Any, scores: Mapping[str, Tensor] | None
    ) -> tuple[dict[str, Figure], dict[str, Tensor]]:
        """Return the figures by name, and the coordinates of the sampler's readouts.

        Args:
            module: the experiment.
            batch: the clouds.
            scores: test metrics by name; None before the test.
        """
        points, sampler, m = batch.points, module.sampler, module.m
        # Baselines do not change in training, so they are drawn once, at the end.
        baselines = () if scores is None else module.baselines.items()
        methods = {name: baseline(points, m).points for name, baseline in baselines}
        if sampler is None:
            return figures_of(module.task, batch, {**methods, FULL: points}, self.titles), {}
        output = sampler(points, m)
        samples = readouts(points, {m: output}, sampler)[m]
        figures = figures_of(module.task, batch, {**methods, **samples}, self.titles)
        titles = cloud_titles(module.task, self.titles)
        if scores is not None:
            main = {**methods, module.main_readout: samples[module.main_readout]}
            figures["comparison"] = self._comparison(module, points, main, scores)
        figures["clouds"] = drawing.cloud_grid(points, samples, titles)
        matrix = output.matrix
        if matrix is not None and points.shape[1] * matrix.m <= DENSE_PIXELS:
            first = matrix.first_cloud()
            figures["matrix"] = drawing.matrix_figure(first.dense()[0], first.gram()[0], titles[0])
        return figures, samples

    def _comparison(
        self,
        module: Any,
        points: Tensor,
        samples: Mapping[str, Tensor],
        scores: Mapping[str, Tensor],
    ) -> Figure:
        """Draw one cloud with the sample of each method, under the method's test score."""
        shown = (len(self.titles) - 1) // 2
        info = MetricInfo.of(module.task.score, module.task.metrics()[module.task.score])
        labels = {module.main_readout: type(module.sampler).__name__, FULL: "all points"}
        captions = {}
        for name in (*samples, FULL):
            prefix = "" if name == FULL else module.prefixes[module.m]
            score = scores.get(f"test/{prefix}{name}/{info.name}")
            value = "" if score is None else f": {info.format(float(score))} {info.unit}"
            captions[name] = labels.get(name, name) + value
        drawn = {name: chosen[shown] for name, chosen in samples.items()}
        return drawing.comparison(points[shown], drawn, captions)


def cloud_titles(task: Task, titles: Sequence[str]) -> list[str]:
    """Return one title per cloud of a batch, from one per cloud of the data."""
    if task.clouds_per_prediction == 1:
        return list(titles)
    return [f"{title}_{side}" for side in ("source", "target") for title in titles]


def clouds_to_draw(dataset: CloudDataset, number: int) -> tuple[Tensor, list[str]]:
    """Choose test clouds, spread over all classes and, of one class, over all its clouds.

    Clouds of one file are next to each other, so that clouds of several files are chosen.

    Returns:
        Rows of the test split, at most ``number``, and their titles: the names of their classes,
        counted where a class has several clouds.
    """
    labels = dataset.test.labels
    classes = len(dataset.class_names)
    wanted = torch.linspace(0, classes - 1, min(max(number, 1), classes)).round().long()
    present = [int(label) for label in wanted.unique() if label in labels][:number]
    rows: list[int] = []
    titles: list[str] = []
    for place, label in enumerate(present):
        members = (labels == label).nonzero()[:, 0]
        share = number // len(present) + (1 if place < number % len(present) else 0)
        spread = torch.linspace(0, len(members) - 1, min(share, len(members))).round().long()
        chosen = members[spread].tolist()
        name = dataset.class_names[label]
        rows += chosen
        titles += [name] if len(chosen) == 1 else [f"{name} {k}" for k in range(1, len(chosen) + 1)]
    return torch.tensor(rows, dtype=torch.int64), titles
