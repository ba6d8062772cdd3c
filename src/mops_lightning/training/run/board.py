"""The TensorBoard logger: its first screen shows the curves that matter, for all runs."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only
from torch import Tensor
from torch.utils.tensorboard.summary import hparams

from mops_lightning.records.readout_names import FULL, GENERATED_READOUTS, INDEX_READOUT, PROJECTED
from mops_lightning.records.run_record import RunRecord
from mops_lightning.records.summary import shown_names
from mops_lightning.tree import dotted
from mops_lightning.viz.figures import COLOURS, INPUT_COLOUR, thinned

ORDER = (*GENERATED_READOUTS, PROJECTED, INDEX_READOUT, FULL)
"""Readouts in the order of their curves."""

OTHERS = {
    "train/mean_loss": "7 train loss",
    "train/tau": "8 tau",
}
"""Further curves of the first screen. TensorBoard sorts by name: the numbers put these last."""

ALWAYS_SHOWN = ("m", "seed", "learn", "batch_size", "optimizer.lr", "trainer.max_epochs")
"""Settings of the HPARAMS table beside the groups' names and what the user has changed."""


class Board(TensorBoardLogger):
    """TensorBoard's logger with the curves that matter in a group of their own, ``curves``.

    TensorBoard sorts groups by name, so that this group comes first: the score of held-out clouds
    by readout, then the loss of the training and the temperature. The curve of epochs is left out.

    Args:
        save_dir: the run's folder; TensorBoard calls the run by it.
        score: the metric whose curves come first.
        name: as for Lightning's ``TensorBoardLogger``, like the next five.
        version: a folder below the name's.
        log_graph: whether the net's graph is logged.
        default_hp_metric: whether a metric of -1 is logged with settings.
        prefix: prefix of all names.
        sub_dir: a folder below the version's.
        **writer: settings of torch's ``SummaryWriter``.
    """

    def __init__(
        self,
        save_dir: str | Path,
        score: str = "accuracy",
        name: str | None = "",
        version: int | str | None = "",
        log_graph: bool = False,
        default_hp_metric: bool = False,
        prefix: str = "",
        sub_dir: str | None = None,
        **writer: Any,
    ) -> None:
        super().__init__(
            save_dir, name, version, log_graph, default_hp_metric, prefix, sub_dir, **writer
        )
        self.score = score

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Log values under the names of their curves."""
        named = {}
        for name, value in metrics.items():
            if name != "epoch":
                named[curve_name(name, self.score)] = value
        super().log_metrics(named, step)

    @rank_zero_only
    def log_test(self, record: RunRecord, scores: Mapping[str, float], step: int) -> None:
        """Log a test: its metrics as a table of text, its settings and scores for HPARAMS.

        As curves of one point each, test metrics would bury the curves of the training. Lightning
        also logs a summary of the experiment with this run's settings alone, and TensorBoard takes
        the first that it finds for all runs. Without one it compares the runs itself and shows the
        settings that differ first.

        Args:
            record: the run's record, with its metrics.
            scores: the metrics that are shown beside the settings.
            step: step of the training.
        """
        lines = ["| metric | value |", "|---|--:|"]
        for name, value in sorted(record.metrics.items()):
            lines.append(f"| {name} | {value:.6g} |")
        self.experiment.add_text("test", "\n".join(lines), step)
        _, *session = hparams({**board_settings(record), **scores}, {})
        for summary in session:
            self.experiment.file_writer.add_summary(summary)

    @rank_zero_only
    def add_clouds(self, points: Tensor, samples: Mapping[str, Tensor], step: int) -> None:
        """Log clouds and their samples as meshes, which TensorBoard shows in 3-D.

        Args:
            points: ``(K, N, 3)`` input.
            samples: ``(K, M, 3)`` by readout.
            step: step of the training.
        """
        cloud = thinned(points.detach().cpu().float())
        grey = torch.tensor(INPUT_COLOUR).expand(cloud.shape)
        for name, sample in samples.items():
            sampled = sample.detach().cpu().float()
            rgb = COLOURS.get(name, COLOURS["sampled"])
            colour = torch.tensor(rgb).expand(sampled.shape)
            self.experiment.add_mesh(
                f"clouds/{name}",
                torch.cat([cloud, sampled], dim=1),
                torch.cat([grey, colour], dim=1),
                config_dict={"material": {"cls": "PointsMaterial", "size": 0.03}},
                global_step=step,
            )


def curve_name(name: str, score: str) -> str:
    """Return the tag of a value in TensorBoard.

    Args:
        name: its log key, such as ``val/generated/accuracy`` or ``val/m32/matched/accuracy``.
        score: the metric whose curves come first.
    """
    if name in OTHERS:
        return f"curves/{OTHERS[name]}"
    match = re.fullmatch(rf"val/(?:(m\d+)/)?(\w+)/{re.escape(score)}", name)
    if match is None:
        return name
    size, readout = match.groups()
    if readout not in ORDER:
        return name
    number = 1 + ORDER.index(readout)
    curve = f"curves/{number} val {score}, {readout}"
    if size:
        curve += f", {size}"
    return curve


def board_settings(record: RunRecord) -> dict[str, Any]:
    """Return the settings by which runs are told apart: the groups' names, and what was changed."""
    config = dotted(record.config)
    named: dict[str, Any] = dict(shown_names(record.config))
    changed = [override.lstrip("+~").partition("=")[0] for override in record.overrides]
    for key in (*ALWAYS_SHOWN, *changed):
        if key in config:
            named[key] = config[key]
    if record.config.get("tags"):
        named["tags"] = ", ".join(record.config["tags"])
    return {key: _plain(value) for key, value in named.items()}


def _plain(value: Any) -> int | float | str:
    if isinstance(value, int | float | str):
        return value
    return str(value)
