"""Figures of registered pairs and of reconstructed clouds, after the paper's figures."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.axes3d import Axes3D
from torch import Tensor

from mops_lightning.viz.figures import (
    at_edges,
    cloud_axes,
    draw_cloud,
    frame_cloud,
    new_figure,
    thinned,
    upright,
)

SOURCE_COLOUR = (0.12, 0.47, 0.86)
TARGET_COLOUR = (0.84, 0.3, 0.05)
SAMPLE_SIZE = 14


class _Grid(NamedTuple):
    """A figure with one row of clouds below the other."""

    figure: Figure
    rows: int
    columns: int

    @classmethod
    def of(cls, rows: int, columns: int, inches: float) -> "_Grid":
        """Return an empty grid of square cells with sides of so many inches."""
        figure = new_figure(inches * columns, inches * rows, "tight")
        return cls(figure, rows, columns)

    def axes(self, row: int, column: int, title: str, label: str) -> Axes3D:
        """Add the axes of one cell."""
        return cloud_axes(
            self.figure, self.rows, self.columns, row, column, title=title, label=label
        )


class RegistrationResult(NamedTuple):
    """Pairs aligned from the points of one readout.

    Attributes:
        source: ``(K, N, 3)`` the sources after the predicted motion.
        source_points: ``(K, M, 3)`` their sampled points after the predicted motion.
        target_points: ``(K, M, 3)`` the sampled points of the targets.
        errors: rotation errors in degrees, one per pair.
    """

    source: Tensor
    source_points: Tensor
    target_points: Tensor
    errors: Sequence[float]


def pair_grid(
    source: Tensor,
    target: Tensor,
    before: Sequence[float],
    aligned: Mapping[str, RegistrationResult],
    titles: Sequence[str],
) -> Figure:
    """Draw pairs as rows: unaligned, then aligned by every readout with sampled points ringed.

    Args:
        source: ``(K, N, 3)``, y up, drawn blue.
        target: ``(K, N, 3)``, drawn orange.
        before: the angles of the true rotations in degrees, one per pair.
        aligned: by readout.
        titles: one per pair.
    """
    grid = _Grid.of(len(source), 1 + len(aligned), 2.8)
    for row, title in enumerate(titles):
        is_first = row == 0
        head = ""
        if is_first:
            head = "before (centred)"
        axes = grid.axes(row, 0, head, f"{title}, {before[row]:.1f}° apart")
        _draw_whole_pair(axes, source[row], target[row])
        for column, (name, result) in enumerate(aligned.items(), start=1):
            head = ""
            if is_first:
                head = f"by {name}"
            error = result.errors[row]
            axes = grid.axes(row, column, head, f"rotation error {error:.1f}°")
            _draw_whole_pair(axes, result.source[row], target[row])
            if result.source_points.shape[1] < source.shape[1]:
                _draw_rings(axes, result.source_points[row], result.target_points[row])
    grid.figure.supxlabel("source blue, target orange, sampled points ringed", fontsize=9)
    return grid.figure


def _draw_whole_pair(axes: Axes3D, source: Tensor, target: Tensor) -> None:
    _draw_pair(axes, source, target, s=1.5, alpha=0.35)
    frame_cloud(axes, upright(torch.cat([source, target])))


def _draw_rings(axes: Axes3D, source: Tensor, target: Tensor) -> None:
    _draw_pair(axes, source, target, s=SAMPLE_SIZE, edgecolors="black", linewidths=0.4)


def _draw_pair(axes: Axes3D, source: Tensor, target: Tensor, **style: Any) -> None:
    blue = upright(source)
    orange = upright(target)
    axes.scatter(*blue.T, color=SOURCE_COLOUR, depthshade=False, **style)
    axes.scatter(*orange.T, color=TARGET_COLOUR, depthshade=False, **style)


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
    points: Tensor,
    full: Tensor,
    results: Mapping[str, ReconstructionResult],
    titles: Sequence[str],
) -> Figure:
    """Draw every cloud in two rows: the input and its samples above, their reconstructions below.

    Input and reconstructions are coloured by depth, as the paper's scans are.

    Args:
        points: ``(K, N, 3)`` input, y up.
        full: ``(K, n, 3)`` reconstructions from all points.
        results: by readout or sampler, one column each.
        titles: one per cloud.
    """
    grid = _Grid.of(2 * len(points), 1 + len(results), 2.4)
    from_all = upright(full)
    for number, cloud in enumerate(map(thinned, upright(points))):
        above = 2 * number
        under = above + 1
        input_title = ""
        if number == 0:
            input_title = "input"
        axes = grid.axes(above, 0, input_title, titles[number])
        _draw_depth(axes, cloud, cloud)
        axes = grid.axes(under, 0, "from all points", "")
        _draw_depth(axes, thinned(from_all[number]), cloud)
        for column, (name, result) in enumerate(results.items(), start=1):
            samples = upright(result.samples)[number]
            title = ""
            if number == 0:
                title = name
            axes = grid.axes(above, column, title, f"{len(samples)} points")
            draw_cloud(axes, cloud, samples, name, size=16)
            reconstruction = thinned(upright(result.points)[number])
            ratio = result.ratios[number]
            axes = grid.axes(under, column, f"from {name}", f"NRE {ratio:.2f}")
            _draw_depth(axes, reconstruction, cloud)
    return grid.figure


def part_grid(points: Tensor, parts: Mapping[str, Tensor], titles: Sequence[str]) -> Figure:
    """Draw clouds as rows, coloured by part, with one column for each way to tell the parts.

    Args:
        points: ``(K, N, 3)``, y up.
        parts: ``(K, N)`` part numbers, below 0 if unknown, by the name of a column.
        titles: one per cloud.
    """
    grid = _Grid.of(len(points), len(parts), 2.4)
    most = max(int(numbers.max()) for numbers in parts.values())
    scale: dict[str, Any] = {
        "cmap": colormaps["tab20"].with_extremes(under="lightgrey"),  # points of unknown part
        "vmin": 0,
        "vmax": most,
    }
    for row, cloud in enumerate(map(thinned, upright(points))):
        for column, (name, numbers) in enumerate(parts.items()):
            title, label = at_edges(row, column, name, titles[row])
            axes = grid.axes(row, column, title, label)
            of_points = numbers[row].cpu()[:, None]
            drawn = thinned(of_points)[:, 0]
            axes.scatter(*cloud.T, s=2, depthshade=False, c=drawn, **scale)
            frame_cloud(axes, cloud)
    return grid.figure


def _draw_depth(axes: Axes3D, drawn: np.ndarray, cloud: np.ndarray) -> None:
    """Draw points coloured by depth, framed as ``cloud``."""
    heights = drawn[:, 1]
    axes.scatter(*drawn.T, s=2, c=heights, cmap="viridis", depthshade=False)
    frame_cloud(axes, cloud)
