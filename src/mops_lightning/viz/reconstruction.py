"""Figures of reconstructed clouds (after the paper's figures of reconstruction)."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from torch import Tensor

from mops_lightning.viz.clouds import draw_cloud, frame_cloud, upright

DRAWN = 8192
"""Most points drawn of a cloud: more cannot be told apart, and take minutes."""


class ReconstructionResult(NamedTuple):
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
    points: Tensor, full: Tensor, rebuilt: Mapping[str, ReconstructionResult], titles: Sequence[str]
) -> Figure:
    """Draw every cloud in two rows: the input and what was sampled, and what was rebuilt of them.

    Input and reconstructions are coloured by depth, as the paper's scans are.

    Args:
        points: ``(K, N, 3)`` input, y up.
        full: ``(K, n, 3)`` what all points give.
        rebuilt: by readout or method, one column for each.
        titles: one per cloud.
    """
    columns, rows = 1 + len(rebuilt), 2 * len(points)
    figure = Figure(figsize=(2.4 * columns, 2.4 * rows), layout="tight")
    FigureCanvasAgg(figure)

    def cell(row: int, column: int, title: str, below: str) -> Axes3D:
        axes: Any = figure.add_subplot(rows, columns, row * columns + column + 1, projection="3d")
        if row % 2 == 1 or row == 0:
            axes.set_title(title, fontsize=10)
        axes.text2D(0.02, 0.02, below, transform=axes.transAxes, fontsize=8)
        return axes

    for number, cloud in enumerate(map(_thinned, upright(points))):
        above, under = 2 * number, 2 * number + 1
        _draw_depth(cell(above, 0, "input", titles[number]), cloud, cloud)
        whole = _thinned(upright(full)[number])
        _draw_depth(cell(under, 0, "from all points", ""), whole, cloud)
        for column, (name, result) in enumerate(rebuilt.items(), start=1):
            samples = upright(result.samples)[number]
            axes = cell(above, column, name, f"{len(samples)} points")
            draw_cloud(axes, cloud, samples, name, size=16)
            axes = cell(under, column, f"from {name}", f"NRE {result.ratios[number]:.2f}")
            _draw_depth(axes, _thinned(upright(result.points)[number]), cloud)
    return figure


def _draw_depth(axes: Axes3D, drawn: np.ndarray, cloud: np.ndarray) -> None:
    """Draw points coloured by depth, in the frame of ``cloud``."""
    axes.scatter(*drawn.T, s=2, c=drawn[:, 1], cmap="viridis", depthshade=False)
    frame_cloud(axes, cloud)


def _thinned(cloud: np.ndarray) -> np.ndarray:
    """Leave out points evenly above ``DRAWN``."""
    return cloud[:: -(-len(cloud) // DRAWN)]
