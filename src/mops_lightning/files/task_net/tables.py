"""What a comparison by a task net shows: tables, a curve and a page."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import floor, log10
from pathlib import Path
from statistics import fmean, stdev

import pandas as pd
from matplotlib.figure import Figure

from mops_lightning.files.arguments import counted
from mops_lightning.files.task_net.keep import Choice, by_part, by_size
from mops_lightning.files.task_net.measure import ALL, EVERYTHING, LOSS
from mops_lightning.filesystem import atomic_write
from mops_lightning.metrics.info import MetricInfo
from mops_lightning.records.verdict import verdict
from mops_lightning.report.page import render
from mops_lightning.report.plots import COLOURS
from mops_lightning.report.tables import Cell, Part
from mops_lightning.report.text import BEST, Grid, markdown
from mops_lightning.viz.figures import new_figure, save_figure

TABLE = "table.csv"
TEXT = "table.md"
CURVE = "curve.svg"
PAGE = "compare.html"
FILES = (TABLE, TEXT, CURVE, PAGE)
"""The files of a comparison."""

MEANINGS = [
    "Every figure is the mean over the draws, ± the standard deviation between draws; every draw "
    "has other crops and other random choices. All methods of a draw see the same clouds. Bold: "
    "the best mean. A method counts as better than farthest points if the difference exceeds twice "
    "its standard error, which is taken over the draws of both halves of the files.",
    "- Points are input points: of trained samplers, completed sets are scored.",
    "- fps: farthest points from a drawn point; fps_farthest: from the point farthest from the "
    "mean. critical: points that win the maxima of the net's features. trained: the trained "
    "sampler.",
]


@dataclass(frozen=True)
class Comparison:
    """The scores of all methods.

    Attributes:
        frame: one row for every draw, group of files, number of points and method; see
            ``measure.Score``.
        metric: of the column ``score``.
        net: name of the task net.
        files: their number.
        own: names of the trained samplers.
        choices: what was kept for every number of points; empty: nothing.
        saved: the file with these methods, or None.
    """

    frame: pd.DataFrame
    metric: MetricInfo
    net: str
    files: int
    own: list[str]
    choices: list[Choice]
    saved: Path | None

    @property
    def sentence(self) -> str:
        """Which method to use for how many points."""
        scores = by_size(self.frame, ALL)
        parts = by_part(self.frame)
        return verdict(scores, self.metric, self.own, parts)

    @property
    def text(self) -> str:
        """The tables, how to read them, what was kept, and the sentence."""
        remarks = [*MEANINGS, *self._ending()]
        return markdown(self._grids(), remarks)

    def write(self, folder: Path) -> None:
        """Write ``FILES`` to a folder."""
        contents = {
            TABLE: self.frame.to_csv(index=False, lineterminator="\n"),
            TEXT: self.text,
        }
        for name, content in contents.items():
            with atomic_write(folder / name) as temporary:
                temporary.write_text(content, encoding="utf-8")
        curve = save_figure(self._curve(), folder / CURVE)
        remarks = [*self._ending(), *MEANINGS]
        page = render("compare", self._grids(), [], remarks, "What to use", [curve])
        with atomic_write(folder / PAGE) as temporary:
            temporary.write_text(page, encoding="utf-8")

    def _ending(self) -> list[str]:
        """Return what was kept, and the sentence."""
        lines = []
        if self.saved is not None:
            lines += ["", f"Kept in {self.saved}, chosen on one half of the files:"]
            lines += [f"- {choice.line}" for choice in self.choices]
        if self.sentence:
            lines += ["", self.sentence]
        return lines

    def _grids(self) -> list[Grid]:
        """Return a table of scores, and one of losses where the score is another value."""
        grids = [self._grid("score", self.metric)]
        if self.metric != LOSS:
            grids.append(self._grid("loss", LOSS))
        return grids

    def _grid(self, column: str, metric: MetricInfo) -> Grid:
        frame = self.frame[self.frame.files == ALL]
        sizes = [m for m in frame.m.unique() if m]
        draws = frame.draw.nunique()
        clouds = frame.clouds.iloc[0]
        draws_of_clouds = f"{counted(draws, 'draw')} of {counted(clouds, 'cloud')}"
        files = counted(self.files, "file")
        title = f"{metric.title} of {self.net}: {draws_of_clouds} from {files}"
        best = {m: _best(frame[frame.m == m], column, metric) for m in sizes}
        rows: list[list[str | Cell]] = []
        for method in frame.method.unique():
            of_method = frame[frame.method == method]
            row: list[str | Cell] = [method]
            for m in sizes:
                size = m
                if method == EVERYTHING:
                    size = 0
                rank = 0
                if method in best[m]:
                    rank = BEST
                values = of_method[of_method.m == size][column]
                row.append(_cell(values.tolist(), metric, rank))
            rows.append(row)
        rows.sort(key=lambda row: row[0] == EVERYTHING)
        head = ["method"]
        head += [f"m={m:,}" for m in sizes]
        return Grid(title, head, rows)

    def _curve(self) -> Figure:
        """Draw the score against the number of points."""
        scores = by_size(self.frame, ALL)
        sizes = list(scores)
        figure = new_figure(7.5, 4.2)
        axis = figure.subplots()
        names: dict[str, None] = {}
        for values in scores.values():
            names |= dict.fromkeys(values)
        scale = self.metric.scale
        for number, name in enumerate(names):
            known = [m for m in sizes if name in scores[m]]
            style = "--"
            if name in self.own:
                style = "-"
            axis.errorbar(
                [sizes.index(m) for m in known],
                [scale * fmean(scores[m][name]) for m in known],
                yerr=[scale * _spread(scores[m][name]) for m in known],
                label=name,
                color=COLOURS[number % len(COLOURS)],
                linestyle=style,
                marker="o",
                markersize=3,
                capsize=2,
            )
        is_whole = (self.frame.files == ALL) & (self.frame.method == EVERYTHING)
        of_whole = scale * self.frame[is_whole].score.mean()
        axis.axhline(of_whole, color="grey", linewidth=0.8, label=EVERYTHING)
        axis.set_xticks(range(len(sizes)), [f"{m:,}" for m in sizes])
        axis.set(xlabel="points", ylabel=self.metric.title)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
        return figure


def _best(frame: pd.DataFrame, column: str, metric: MetricInfo) -> set[str]:
    """Return the method with the best mean, or all methods that share it."""
    means = frame.groupby("method", sort=False)[column].mean()
    best = means.min()
    if metric.higher_is_better:
        best = means.max()
    is_best = means == best
    return set(means.index[is_best])


def _spread(values: Sequence[float]) -> float:
    if len(values) == 1:
        return 0.0
    return stdev(values)


def _cell(values: Sequence[float], metric: MetricInfo, rank: int) -> str | Cell:
    """Return the mean of the draws, and their standard deviation where there are several."""
    if not values:
        return "-"
    form = _form(metric, fmean(values))
    mean = format(metric.scale * fmean(values), form)
    if len(values) == 1:
        return Cell((Part(mean, rank),))
    deviation = format(metric.scale * stdev(values), form)
    return Cell((Part(mean, rank),), f" ± {deviation}")


def _form(metric: MetricInfo, mean: float) -> str:
    """Return the format of a mean and its spread: two decimals, or four digits of the mean."""
    if metric.unit or not mean:
        return ".2f"
    decimals = 3 - floor(log10(abs(mean)))
    if decimals >= 7:
        return ".2e"
    return f".{max(decimals, 0)}f"
