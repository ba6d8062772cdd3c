"""Figures of registered pairs (after the paper's figure of registration)."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from mops_lightning.viz.clouds import frame_cloud, upright

SOURCE_COLOUR, TARGET_COLOUR = (0.12, 0.47, 0.86), (0.84, 0.3, 0.05)
KEY_POINT_SIZE = 14


class RegistrationResult(NamedTuple):
    """What one readout made of the pairs.

    Attributes:
        source: ``(K, N, 3)`` the sources after the motion that was found.
        source_points: ``(K, M, 3)`` their sampled points, moved too.
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
    """Draw pairs as rows: as they came, then aligned by every readout, sampled points ringed.

    Args:
        source: ``(K, N, 3)``, y up, drawn blue.
        target: ``(K, N, 3)``, drawn orange.
        before: the angles of the true rotations in degrees, one per pair.
        aligned: by readout.
        titles: one per pair.
    """
    columns = len(aligned) + 1
    figure = Figure(figsize=(2.8 * columns, 2.8 * len(source)), layout="tight")
    FigureCanvasAgg(figure)
    for row in range(len(source)):
        for column, (name, result) in enumerate({"before": None, **aligned}.items()):
            axes = figure.add_subplot(
                len(source), columns, row * columns + column + 1, projection="3d"
            )
            moved = source if result is None else result.source
            for cloud, colour in ((moved, SOURCE_COLOUR), (target, TARGET_COLOUR)):
                axes.scatter(
                    *upright(cloud[row]).T, s=1.5, color=colour, alpha=0.35, depthshade=False
                )
            if result is not None and result.source_points.shape[1] < source.shape[1]:
                for points, colour in (
                    (result.source_points, SOURCE_COLOUR),
                    (result.target_points, TARGET_COLOUR),
                ):
                    axes.scatter(
                        *upright(points[row]).T,
                        s=KEY_POINT_SIZE,
                        color=colour,
                        edgecolors="black",
                        linewidths=0.4,
                        depthshade=False,
                    )
            frame_cloud(axes, np.concatenate([upright(moved[row]), upright(target[row])]))
            if row == 0:
                axes.set_title("before (centred)" if result is None else f"by {name}", fontsize=11)
            below = f"{titles[row]}, {before[row]:.1f}° apart"
            if result is not None:
                below = f"rotation error {result.errors[row]:.1f}°"
            axes.text2D(0.02, 0.04, below, transform=axes.transAxes, fontsize=9)
    figure.supxlabel("source blue, target orange, sampled points ringed", fontsize=9)
    return figure
