"""Figures of reconstructed clouds (after the paper's figures of reconstruction)."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.axes3d import Axes3D
from torch import Tensor

from mops_lightning.viz.clouds import draw_cloud, frame_cloud, upright
from mops_lightning.viz.figures import cloud_axes, new_figure

MAX_POINTS = 8192
"""Most points drawn of a cloud: more are indistinguishable and take minutes."""


class ReconstructionResult(NamedTuple):
    """Clouds reconstructed from the points of one readout.

    Attributes:
        samples: ``(K, M, 3)`` the sampled points.
        points: ``(K, n, 3)`` the reconstructions.
        ratios: normalized reconstruction errors by the chamfer distance, one per cloud.
    """

    samples: Tensor
    points: Tensor
    ratios: Sequence[float]


def reconstruction_grid(
    points: Tensor, full: Tensor, results: Mapping[str, ReconstructionResult], titles: Sequence[str]
) -> Figure:
    """Draw every cloud in two rows: the input and its samples above, their reconstructions below.

    Input and reconstructions are coloured by depth, as the paper's scans are.

    Args:
        points: ``(K, N, 3)`` input, y up.
        full: ``(K, n, 3)`` reconstructions from all points.
        results: by readout or sampler, one column each.
        titles: one per cloud.
    """
    columns, rows = 1 + len(results), 2 * len(points)
    figure = new_figure(2.4 * columns, 2.4 * rows, "tight")

    def cell(row: int, column: int, title: str, below: str) -> Axes3D:
        # Titles of later clouds would repeat those of the first row.
        shown = title if row % 2 == 1 or row == 0 else ""
        return cloud_axes(figure, rows, columns, row, column, shown, below)

    for number, cloud in enumerate(map(_thinned, upright(points))):
        above, under = 2 * number, 2 * number + 1
        _draw_depth(cell(above, 0, "input", titles[number]), cloud, cloud)
        whole = _thinned(upright(full)[number])
        _draw_depth(cell(under, 0, "from all points", ""), whole, cloud)
        for column, (name, result) in enumerate(results.items(), start=1):
            samples = upright(result.samples)[number]
            axes = cell(above, column, name, f"{len(samples)} points")
            draw_cloud(axes, cloud, samples, name, size=16)
            axes = cell(under, column, f"from {name}", f"NRE {result.ratios[number]:.2f}")
            _draw_depth(axes, _thinned(upright(result.points)[number]), cloud)
    return figure


def _draw_depth(axes: Axes3D, drawn: np.ndarray, cloud: np.ndarray) -> None:
    """Draw points coloured by depth, framed as ``cloud``."""
    axes.scatter(*drawn.T, s=2, c=drawn[:, 1], cmap="viridis", depthshade=False)
    frame_cloud(axes, cloud)


def _thinned(cloud: np.ndarray) -> np.ndarray:
    """Keep every k-th point of clouds above ``MAX_POINTS``."""
    return cloud[:: -(-len(cloud) // MAX_POINTS)]
