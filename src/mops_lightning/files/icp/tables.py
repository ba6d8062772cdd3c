"""The table of a comparison by registration."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import fmean, stdev

import pandas as pd

from mops_lightning.files.arguments import COMPARED, counted
from mops_lightning.files.icp.measure import ALIGNED, Score
from mops_lightning.files.icp.methods import FPS_FARTHEST, TRAINED
from mops_lightning.filesystem import atomic_write
from mops_lightning.metrics.info import MetricInfo
from mops_lightning.records.verdict import verdict
from mops_lightning.report.page import render
from mops_lightning.report.text import Grid, markdown

RIVAL = FPS_FARTHEST
"""The method to which the others are compared draw by draw."""

ROTATION = MetricInfo("degrees", label="rotation error", unit="°", higher_is_better=False)
"""By which methods are judged."""

HEAD = [
    "method",
    "points",
    "rotation error (deg)",
    f"against {RIVAL} (%)",
    f"below {ALIGNED:g} deg (%)",
    "shift error",
    "sampling (ms)",
    "aligning (ms)",
]

MEANINGS = [
    "Every figure is the mean over the draws, ± the standard deviation between draws. All methods "
    "of a draw see the same pairs and starts.",
    "- rotation error: median angle between the pose that is found and the true one. "
    f"below {ALIGNED:g} deg: share of smaller errors, better when higher.",
    f"- against {RIVAL}: how much larger the rotation error is, draw by draw.",
    "- shift error: median distance between the true and the found place of the source's mean, in "
    "the clouds' unit (crops: their radius).",
    "- sampling: median processor time of a cloud, normals included; small_gicp_voxel: one pass of "
    "its filter at a known size. aligning: that of an alignment by small_gicp with one thread.",
]


def write_scores(scores: Sequence[Score], folder: Path) -> str:
    """Write the table of every draw and the page, and return the means over draws as text."""
    frame = pd.DataFrame([asdict(score) for score in scores])
    sentences = sentences_of(frame)
    remarks = [*MEANINGS, *sentences]
    page = render("compare", grids_of(frame), [], remarks, "How to read this")
    csv = frame.to_csv(index=False, lineterminator="\n")
    for name, content in zip(COMPARED, (csv, page), strict=True):
        with atomic_write(folder / name) as temporary:
            temporary.write_text(content, encoding="utf-8")
    return "\n".join([as_text(frame), *sentences])


def sentences_of(frame: pd.DataFrame) -> list[str]:
    """Return for every registration which method to use for how many points; see ``as_text``."""
    sentences = []
    for registration in frame.registration.unique():
        is_chosen = (frame.registration == registration) & (frame.m > 0)
        scores: dict[int, dict[str, list[float]]] = defaultdict(dict)
        groups = frame[is_chosen].groupby(["m", "method"], sort=False)
        for (m, method), group in groups:
            scores[int(m)][str(method)] = group.degrees.tolist()
        sentence = verdict(scores, ROTATION, [TRAINED])
        if sentence:
            sentences.append(f"{registration}: {sentence}")
    return sentences


def as_text(frame: pd.DataFrame) -> str:
    """Return the means over draws as text.

    Args:
        frame: columns of ``Score``, such as those of ``table.csv``.
    """
    return markdown(grids_of(frame), MEANINGS)


def grids_of(frame: pd.DataFrame) -> list[Grid]:
    """Return a table for every registration and number of points; see ``as_text``."""
    grids = []
    for registration in frame.registration.unique():
        by_registration = frame[frame.registration == registration]
        for m in by_registration.m.unique():
            of_size = by_registration[by_registration.m == m]
            grids.append(_grid(of_size, registration, m))
    return grids


def _grid(frame: pd.DataFrame, registration: str, m: int) -> Grid:
    size = "all points"
    if m:
        size = f"{m:,} points"
    draws = frame.draw.nunique()
    pairs = frame.pairs.iloc[0]
    title = f"{registration}, {size}: {counted(draws, 'draw')} of {counted(pairs, 'alignment')}"
    rival = frame[frame.method == RIVAL].degrees
    rows = []
    for method in frame.method.unique():
        by_draw = frame[frame.method == method]
        against = "-"
        if len(rival) and method != RIVAL:
            ratios = by_draw.degrees.to_numpy() / rival.to_numpy()
            against = _spread(ratios - 1, 100, "+.1f")
        rows.append(
            [
                method,
                f"{by_draw.points.mean():,.0f}",
                _spread(by_draw.degrees, 1, ".3f"),
                against,
                _spread(by_draw.aligned, 100, ".1f"),
                _spread(by_draw["shift"], 1, ".4f"),
                f"{1000 * by_draw.sampling.mean():.2f}",
                f"{1000 * by_draw.aligning.mean():.2f}",
            ]
        )
    return Grid(title, HEAD, rows)


def _spread(values: Sequence[float], scale: float, form: str) -> str:
    """Return the mean of the draws, and their standard deviation where there are several."""
    scaled = [scale * value for value in values]
    mean = format(fmean(scaled), form)
    if len(scaled) == 1:
        return mean
    deviation = format(stdev(scaled), form.lstrip("+"))
    return f"{mean} ± {deviation}"
