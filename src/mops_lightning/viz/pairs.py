"""Figures of registered pairs (after the paper's figure of registration)."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.axes3d import Axes3D
from torch import Tensor

from mops_lightning.viz.clouds import frame_cloud, upright
from mops_lightning.viz.figures import cloud_axes, new_figure

SOURCE_COLOUR, TARGET_COLOUR = (0.12, 0.47, 0.86), (0.84, 0.3, 0.05)
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
    columns = {"before (centred)": None, **{f"by {name}": one for name, one in aligned.items()}}
    figure = new_figure(2.8 * len(columns), 2.8 * len(source), "tight")
    for row in range(len(source)):
        for column, (head, result) in enumerate(columns.items()):
            below = f"{titles[row]}, {before[row]:.1f}° apart"
            if result is not None:
                below = f"rotation error {result.errors[row]:.1f}°"
            title = head if row == 0 else ""
            axes = cloud_axes(figure, len(source), len(columns), row, column, title, below)
            moved = (source if result is None else result.source)[row]
            _draw_points(axes, moved, target[row])
            if result is not None and result.source_points.shape[1] < source.shape[1]:
                _draw_samples(axes, result.source_points[row], result.target_points[row])
            frame_cloud(axes, np.concatenate([upright(moved), upright(target[row])]))
    figure.supxlabel("source blue, target orange, sampled points ringed", fontsize=9)
    return figure


def _draw_points(axes: Axes3D, source: Tensor, target: Tensor) -> None:
    for cloud, colour in ((source, SOURCE_COLOUR), (target, TARGET_COLOUR)):
        axes.scatter(*upright(cloud).T, s=1.5, color=colour, alpha=0.35, depthshade=False)


def _draw_samples(axes: Axes3D, source: Tensor, target: Tensor) -> None:
    for points, colour in ((source, SOURCE_COLOUR), (target, TARGET_COLOUR)):
        axes.scatter(
            *upright(points).T,
            s=SAMPLE_SIZE,
            color=colour,
            edgecolors="black",
            linewidths=0.4,
            depthshade=False,
        )
