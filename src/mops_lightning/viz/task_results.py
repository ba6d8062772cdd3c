"""Figures of registered pairs and of reconstructed clouds, after the paper's figures."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.axes3d import Axes3D
from torch import Tensor

from mops_lightning.viz import figures

SOURCE_COLOUR = (0.12, 0.47, 0.86)
TARGET_COLOUR = (0.84, 0.3, 0.05)
SAMPLE_SIZE = 14


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
    columns = {"before (centred)": None, **{f"by {name}": aligned[name] for name in aligned}}
    figure = figures.new_figure(2.8 * len(columns), 2.8 * len(source), "tight")
    for row in range(len(source)):
        for column, (head, result) in enumerate(columns.items()):
            label = f"{titles[row]}, {before[row]:.1f}° apart"
            if result is not None:
                label = f"rotation error {result.errors[row]:.1f}°"
            title = head if row == 0 else ""
            axes = figures.cloud_axes(figure, len(source), len(columns), row, column, title, label)
            moved = (source if result is None else result.source)[row]
            _draw_pair(axes, moved, target[row], s=1.5, alpha=0.35)
            if result is not None and result.source_points.shape[1] < source.shape[1]:
                samples = result.source_points[row], result.target_points[row]
                _draw_pair(axes, *samples, s=SAMPLE_SIZE, edgecolors="black", linewidths=0.4)
            figures.frame_cloud(axes, figures.upright(torch.cat([moved, target[row]])))
    figure.supxlabel("source blue, target orange, sampled points ringed", fontsize=9)
    return figure


def _draw_pair(axes: Axes3D, source: Tensor, target: Tensor, **style: Any) -> None:
    for points, colour in ((source, SOURCE_COLOUR), (target, TARGET_COLOUR)):
        axes.scatter(*figures.upright(points).T, color=colour, depthshade=False, **style)


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
    columns = 1 + len(results)
    rows = 2 * len(points)
    figure = figures.new_figure(2.4 * columns, 2.4 * rows, "tight")

    def cell(row: int, column: int, title: str, label: str) -> Axes3D:
        # Titles of later clouds would repeat the titles of the first row.
        shown = title if row % 2 == 1 or row == 0 else ""
        return figures.cloud_axes(figure, rows, columns, row, column, shown, label)

    for number, cloud in enumerate(map(figures.thinned, figures.upright(points))):
        above = 2 * number
        under = 2 * number + 1
        _draw_depth(cell(above, 0, "input", titles[number]), cloud, cloud)
        from_full = figures.thinned(figures.upright(full)[number])
        _draw_depth(cell(under, 0, "from all points", ""), from_full, cloud)
        for column, (name, result) in enumerate(results.items(), start=1):
            samples = figures.upright(result.samples)[number]
            axes = cell(above, column, name, f"{len(samples)} points")
            figures.draw_cloud(axes, cloud, samples, name, size=16)
            axes = cell(under, column, f"from {name}", f"NRE {result.ratios[number]:.2f}")
            _draw_depth(axes, figures.thinned(figures.upright(result.points)[number]), cloud)
    return figure


def part_grid(points: Tensor, parts: Mapping[str, Tensor], titles: Sequence[str]) -> Figure:
    """Draw clouds as rows, coloured by part, with one column for each way to tell the parts.

    Args:
        points: ``(K, N, 3)``, y up.
        parts: ``(K, N)`` part numbers, below 0 if unknown, by the name of a column.
        titles: one per cloud.
    """
    figure = figures.new_figure(2.4 * len(parts), 2.4 * len(points), "tight")
    most = max(int(numbers.max()) for numbers in parts.values())
    colour = colormaps["tab20"].with_extremes(under="lightgrey")  # for points of unknown part
    for row, cloud in enumerate(map(figures.thinned, figures.upright(points))):
        for column, (name, numbers) in enumerate(parts.items()):
            title = name if row == 0 else ""
            label = titles[row] if column == 0 else ""
            axes = figures.cloud_axes(figure, len(points), len(parts), row, column, title, label)
            drawn = figures.thinned(numbers[row, :, None].cpu())[:, 0]
            colours: Any = {"c": drawn, "cmap": colour, "vmin": 0, "vmax": most}
            axes.scatter(*cloud.T, s=2, depthshade=False, **colours)
            figures.frame_cloud(axes, cloud)
    return figure


def _draw_depth(axes: Axes3D, drawn: np.ndarray, cloud: np.ndarray) -> None:
    """Draw points coloured by depth, framed as ``cloud``."""
    axes.scatter(*drawn.T, s=2, c=drawn[:, 1], cmap="viridis", depthshade=False)
    figures.frame_cloud(axes, cloud)
