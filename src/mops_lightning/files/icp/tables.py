"""The table of a comparison by registration."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import fmean, stdev

import pandas as pd

from mops_lightning.files.arguments import COMPARED
from mops_lightning.files.icp.measure import ALIGNED, Score
from mops_lightning.files.icp.methods import FPS_FARTHEST
from mops_lightning.filesystem import atomic_write
from mops_lightning.report.page import render
from mops_lightning.report.text import Grid, markdown

RIVAL = FPS_FARTHEST
"""The method to which the others are compared draw by draw."""

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
    "see the same pairs and starts.",
    "- rotation error: median angle between the pose that is found and the true one. "
    f"below {ALIGNED:g} deg: share of smaller errors, better when higher.",
    f"- against {RIVAL}: how much larger the rotation error is, draw by draw.",
    "- shift error: median distance between the true and the found place of the source's mean, in "
    "the clouds' unit (crops: their radius).",
    "- sampling: median processor time of a cloud, normals included; small_gicp_voxel: one pass of "
    "its filter at a known size. aligning: that of an alignment by small_gicp with one thread.",
]


def write_scores(scores: Sequence[Score], source: str, folder: Path) -> str:
    """Write the table of every draw and the page, and return the means over draws as text.

    Args:
        scores: of all draws.
        source: what was aligned, for the captions.
        folder: where to write.
    """
    frame = pd.DataFrame([asdict(score) for score in scores])
    grids = [
        _grid(frame[chosen], registration, m, source)
        for registration in frame.registration.unique()
        for m in frame.m.unique()
        if (chosen := (frame.registration == registration) & (frame.m == m)).any()
    ]
    page = render("compare", grids, [], MEANINGS, "How to read this")
    csv = frame.to_csv(index=False, lineterminator="\n")
    for name, content in zip(COMPARED, (csv, page), strict=True):
        with atomic_write(folder / name) as temporary:
            temporary.write_text(content, encoding="utf-8")
    return markdown(grids, MEANINGS)


def _grid(frame: pd.DataFrame, registration: str, m: int, source: str) -> Grid:
    size = f"{m:,} points" if m else "all points"
    title = f"{registration}, {size}, {source}"
    rival = frame[frame.method == RIVAL].degrees
    rows = []
    for method in frame.method.unique():
        draws = frame[frame.method == method]
        against = "-"
        if len(rival) and method != RIVAL:
            against = _spread(draws.degrees.to_numpy() / rival.to_numpy() - 1, 100, "+.1f")
        rows.append(
            [
                method,
                f"{draws.points.mean():,.0f}",
                _spread(draws.degrees, 1, ".2f"),
                against,
                _spread(draws.aligned, 100, ".1f"),
                _spread(draws["shift"], 1, ".4f"),
                f"{1000 * draws.sampling.mean():.2f}",
                f"{1000 * draws.aligning.mean():.2f}",
            ]
        )
    return Grid(title, HEAD, rows)


def _spread(values: Sequence[float], scale: float, form: str) -> str:
    """Return the mean of the draws, and their standard deviation where there are several."""
    scaled = [scale * value for value in values]
    mean = format(fmean(scaled), form)
    return f"{mean} ± {format(stdev(scaled), form.lstrip('+'))}" if len(scaled) > 1 else mean
