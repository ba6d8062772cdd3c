"""Figures of reconstructed clouds (after the paper's figures of reconstruction)."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from mops_lightning.pictures import draw_cloud, frame_cloud, upright

DRAWN = 8192
"""Most points drawn of a cloud: more cannot be told apart, and take minutes."""


class Rebuilt(NamedTuple):
    """What one readout made of the clouds.

    Attributes:
        samples: ``(K, M, 3)`` the sampled points.
        points: ``(K, n, 3)`` the reconstructions.
        ratios: normalized reconstruction errors by the chamfer distance, one per cloud.
    """

    samples: Tensor
    points: Tensor
    ratios: Sequence[float]


def rebuilt_grid(
    points: Tensor, full: Tensor, rebuilt: Mapping[str, Rebuilt], titles: Sequence[str]
) -> Figure:
    """Draw clouds as rows: input, its reconstruction, then samples and reconstruction by readout.

    Reconstructions are coloured by depth, as the paper's scans are.

    Args:
        points: ``(K, N, 3)`` input, y up.
        full: ``(K, n, 3)`` what all points give.
        rebuilt: by readout.
        titles: one per cloud.
    """
    columns = 2 + 2 * len(rebuilt)
    figure = Figure(figsize=(2.4 * columns, 2.4 * len(points)), layout="tight")
    FigureCanvasAgg(figure)
    for row, cloud in enumerate(map(_thinned, upright(points))):
        cells: list[tuple[str, np.ndarray, np.ndarray | None, str]]
        cells = [("input", cloud, None, titles[row])]
        cells.append(("all points", _thinned(upright(full)[row]), None, ""))
        for name, result in rebuilt.items():
            samples = upright(result.samples)[row]
            cells.append((name, cloud, samples, f"{samples.shape[0]} points"))
            below = f"NRE {result.ratios[row]:.2f}"
            cells.append((f"from {name}", _thinned(upright(result.points)[row]), None, below))
        for column, (title, drawn, samples, below) in enumerate(cells):
            axes = figure.add_subplot(
                len(points), columns, row * columns + column + 1, projection="3d"
            )
            if samples is None:
                axes.scatter(*drawn.T, s=2, c=drawn[:, 1], cmap="viridis", depthshade=False)
                frame_cloud(axes, cloud)
            else:
                draw_cloud(axes, cloud, samples, title, size=16)
            if row == 0:
                axes.set_title(title, fontsize=10)
            axes.text2D(0.02, 0.02, below, transform=axes.transAxes, fontsize=8)
    return figure


def _thinned(cloud: np.ndarray) -> np.ndarray:
    """Leave out points evenly above ``DRAWN``."""
    return cloud[:: -(-len(cloud) // DRAWN)]
