"""The callback that draws the same few test clouds during training and after the test."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from lightning.fabric.utilities import move_data_to_device
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor

from mops_lightning.records.readout_names import FULL
from mops_lightning.training.readouts import readouts
from mops_lightning.viz.clouds import (
    COLOURS,
    INPUT_COLOUR,
    cloud_grid,
    matrix_figure,
)
from mops_lightning.viz.figures import save_figure
from mops_lightning.viz.snapshots import CLOUDS, save_clouds

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
    """

    def __init__(self, batch: Any, titles: Sequence[str], folder: Path) -> None:
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

    @torch.no_grad()
    def _draw(self, trainer: L.Trainer, module: L.LightningModule, folder: Path | None) -> None:
        if not trainer.is_global_zero:
            return
        board = trainer.logger if isinstance(trainer.logger, TensorBoardLogger) else None
        if board is None and folder is None:
            return
        sampler: Any = module.sampler
        task: Any = module.task
        m: Any = module.m
        training = module.training
        module.eval()
        batch = move_data_to_device(self.batch, module.device)
        beside: Any = module.baselines
        # Baselines do not change in training, so they are drawn once, at the end.
        baselines = dict(beside.items()) if folder is not None else {}
        points = batch.points
        methods = {name: baseline(points, m).points for name, baseline in baselines.items()}
        output = None if sampler is None else sampler(points, m)
        sampled = {} if output is None else readouts(points, {m: output}, sampler)[m]
        figures = task.figures(batch, {**methods, **(sampled or {FULL: points})}, self.titles)
        titles = task.cloud_titles(self.titles)
        if output is not None:
            figures["clouds"] = cloud_grid(points, sampled, titles)
            matrix = output.matrix
            if matrix is not None and points.shape[1] * len(matrix.queries) <= DENSE_PIXELS:
                first = matrix._replace(keys=matrix.keys[:1])
                figures["matrix"] = matrix_figure(first.dense()[0], first.gram()[0], titles[0])
        if folder is not None and sampled:
            save_clouds(folder / CLOUDS, points, sampled, titles)
        module.train(training)
        step = trainer.global_step
        for name, figure in figures.items():
            if folder is not None:
                save_figure(figure, folder / f"{name}.png")
            if board is not None:
                board.experiment.add_figure(name, figure, step)
        if board is not None:
            for name, chosen in sampled.items():
                for number, title in enumerate(titles):
                    vertices, colours = _coloured(points[number], chosen[number], name)
                    board.experiment.add_mesh(
                        f"{name}/{number}_{title}",
                        vertices=vertices,
                        colors=colours,
                        config_dict={"material": {"cls": "PointsMaterial", "size": 0.03}},
                        global_step=step,
                    )


def _coloured(points: Tensor, samples: Tensor, readout: str) -> tuple[Tensor, Tensor]:
    """Join one cloud and its samples, ``(1, N + M, 3)``, with a colour for each point."""
    colours = np.concatenate(
        [
            np.tile(np.array(INPUT_COLOUR, np.uint8), (len(points), 1)),
            np.tile(np.array(COLOURS[readout], np.uint8), (len(samples), 1)),
        ]
    )
    return torch.cat([points, samples]).cpu()[None], torch.from_numpy(colours)[None]
