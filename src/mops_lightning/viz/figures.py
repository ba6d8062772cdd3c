"""Figures of sampled clouds and of the sampling matrix, and the clouds for 3-D views in reports.

Without pyplot's global state.
"""

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.axes3d import Axes3D
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from torch import Tensor
from torch.nn.functional import adaptive_max_pool1d

from mops_lightning.channels import coordinates
from mops_lightning.errors import UserError
from mops_lightning.filesystem import atomic_write, load_npz

COLOURS = {
    "generated": (31, 119, 220),
    "matched": (214, 39, 40),
    "completed": (255, 140, 0),
    "projected": (128, 60, 170),
    "sampled": (44, 140, 60),
}
"""RGB, 0 to 255. Blue, red and orange as in the paper; green for index samplers."""
INPUT_COLOUR = (190, 190, 190)
MATRIX_ROWS = 256
"""Most rows of a drawn matrix: single points of more would not be visible."""
LARGE_MARKER_SAMPLES = 256
"""Above this number of samples, markers shrink."""
CLOUDS = "clouds.npz"
INPUT = "input"
TITLES = "titles"
VIEWS: dict[str, dict[str, Any]] = {
    "x": {"vertical_axis": "x", "elev": 35, "azim": -60},
    "y": {"vertical_axis": "z", "elev": 18, "azim": -60},
    "z": {"vertical_axis": "y", "elev": -35, "azim": -60, "roll": 180},
}
"""Matplotlib's view of clouds by their vertical axis. All clouds are drawn as ``upright`` turns
them: y becomes matplotlib's z, and z its negative y. A roll of 180° therefore shows z upwards."""
MAX_INPUT_POINTS = 8192
"""Most input points drawn or saved of a cloud: more are indistinguishable. All samples are."""


def new_figure(width: float, height: float, layout: Any = "constrained") -> Figure:
    """Return an empty figure of a size in inches."""
    figure = Figure(figsize=(width, height), layout=layout)
    FigureCanvasAgg(figure)
    return figure


def cloud_axes(
    figure: Figure,
    rows: int,
    columns: int,
    row: int,
    column: int,
    title: str = "",
    label: str = "",
) -> Axes3D:
    """Add 3-D axes to a grid of clouds.

    Args:
        figure: where to add them.
        rows: of the grid.
        columns: of the grid.
        row: of the new axes, from the top.
        column: of the new axes, from the left.
        title: text above.
        label: text in the lower left corner.
    """
    number = row * columns + column + 1
    axes: Any = figure.add_subplot(rows, columns, number, projection="3d")
    axes.set_title(title, fontsize=11)
    axes.text2D(0.02, 0.04, label, transform=axes.transAxes, fontsize=9)
    return axes


def at_edges(row: int, column: int, title: str, label: str) -> tuple[str, str]:
    """Return the title for the first row only, and the label for the first column only."""
    if row > 0:
        title = ""
    if column > 0:
        label = ""
    return title, label


def save_figure(figure: Figure, path: Path, dpi: float = 110, software: str = "") -> Path:
    """Write a figure as PNG or SVG, completely or not at all.

    A PNG gets a palette of 256 colours, which makes it several times smaller.

    Args:
        figure: what to write.
        path: the file; its suffix gives the format.
        dpi: resolution of a PNG, and of the images in an SVG.
        software: what wrote it, for the metadata; empty: none in a PNG, matplotlib's in an SVG.
    """
    buffer = io.BytesIO()
    if path.suffix == ".svg":
        metadata: dict[str, Any] = {"Date": None}
        if software:
            metadata["Creator"] = software
        figure.savefig(buffer, format="svg", dpi=dpi, metadata=metadata)
        content = buffer.getvalue()
    else:
        figure.savefig(buffer, format="png", dpi=dpi)
        content = _with_palette(buffer, software)
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)
    return path


def _with_palette(png: io.BytesIO, software: str) -> bytes:
    """Return a PNG with 256 colours, and with the name of what wrote it."""
    metadata = PngInfo()
    if software:
        metadata.add_text("Software", software)
    image = Image.open(png).convert("RGB")
    palette = image.quantize(256, dither=Image.Dither.NONE)
    packed = io.BytesIO()
    palette.save(packed, "PNG", optimize=True, pnginfo=metadata)
    return packed.getvalue()


def cloud_grid(
    points: Tensor,
    readouts: Mapping[str, Tensor],
    titles: Sequence[str],
    channel: int | None = None,
) -> Figure:
    """Draw clouds as rows and readouts as columns, each over its faint input.

    Args:
        points: ``(K, N, 3 + C)`` input, y up.
        readouts: ``(K, M, 3 + C)`` by name; names that are not in ``COLOURS`` are drawn green.
        titles: one per cloud.
        channel: the column that gives the colours, dark for low and bright for high values; None:
            the readout does.

    Returns:
        A figure; the first column is the input alone.
    """
    columns = {INPUT: None, **readouts}
    colours: dict[str, np.ndarray] = {}
    if channel is not None:
        colours = colours_by_channel(channel, {INPUT: points, **readouts})
    number = len(points)
    inches = 2.6
    figure = new_figure(inches * len(columns), inches * number, "tight")
    for row, cloud in enumerate(upright(coordinates(points))):
        for column, (name, samples) in enumerate(columns.items()):
            title, label = at_edges(row, column, name, titles[row])
            axes = cloud_axes(figure, number, len(columns), row, column, title, label)
            drawn = None
            if samples is not None:
                drawn = upright(coordinates(samples))[row]
            of_row = None
            if name in colours:
                of_row = colours[name][row]
            draw_cloud(axes, cloud, drawn, name, colours=of_row)
    return figure


def colours_by_channel(channel: int, sets: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
    """Return colours ``(K, M, 3)`` of points ``(K, M, 3 + C)`` by the values of one channel.

    All sets have one scale. It leaves out the most extreme hundredth of the input at both ends, of
    which one would make all others look alike.
    """
    values = {}
    for name, points in sets.items():
        of_channel = points[..., channel].detach()
        values[name] = of_channel.cpu().numpy()
    low, high = np.percentile(values[INPUT], (1, 99))
    spread = 1.0
    if high > low:
        spread = high - low
    scale = colormaps["viridis"]
    colours = {}
    for name, numbers in values.items():
        shares = np.clip((numbers - low) / spread, 0, 1)
        colours[name] = scale(shares)[..., :3]
    return colours


def comparison(
    points: Tensor, samples: Mapping[str, Tensor], captions: Mapping[str, str]
) -> Figure:
    """Draw one cloud with the sample of each method side by side, and the whole cloud last.

    Args:
        points: ``(N, 3)`` input, y up.
        samples: ``(M, 3)`` by the name of a readout or baseline, which gives the colour.
        captions: by the same names, then one for the whole cloud.
    """
    columns = len(captions)
    figure = new_figure(2.4 * columns, 2.9)
    cloud = upright(points)
    for column, (name, caption) in enumerate(captions.items()):
        axes = cloud_axes(figure, 1, columns, 0, column, caption)
        drawn = None
        if name in samples:
            drawn = upright(samples[name])
        draw_cloud(axes, cloud, drawn, name)
    return figure


def draw_cloud(
    axes: Axes3D,
    cloud: np.ndarray,
    samples: np.ndarray | None,
    readout: str,
    size: float = 22,
    colours: np.ndarray | None = None,
) -> None:
    """Draw a cloud, faintly if samples are drawn over it.

    Args:
        axes: where to draw.
        cloud: ``(N, 3)``, z up.
        samples: ``(M, 3)`` or None. They are drawn over the whole cloud, because a dense cloud
            would hide the samples behind it.
        readout: gives the samples' colour.
        size: marker area of up to ``LARGE_MARKER_SAMPLES`` samples; more get smaller markers.
        colours: ``(M, 3)`` of the samples or, without samples, of the cloud; None: one colour.
    """
    axes.computed_zorder = False
    if samples is None:
        _draw_whole(axes, cloud, colours)
    else:
        _draw_faint(axes, cloud)
        _draw_samples(axes, samples, readout, size, colours)
    frame_cloud(axes, cloud)


# Points are rasterized, because thousands of them would make an SVG of megabytes.
def _draw_whole(axes: Axes3D, cloud: np.ndarray, colours: np.ndarray | None) -> None:
    colour: Any = colours
    if colour is None:
        colour = "0.35"
    style = {"alpha": 1.0, "depthshade": False, "rasterized": True}
    axes.scatter(*cloud.T, s=3, color=colour, **style)


def _draw_faint(axes: Axes3D, cloud: np.ndarray) -> None:
    colour = np.array(INPUT_COLOUR) / 255
    style: dict[str, Any] = {"alpha": 0.35, "depthshade": False, "rasterized": True}
    axes.scatter(*cloud.T, s=1, color=colour, **style)


def _draw_samples(
    axes: Axes3D,
    samples: np.ndarray,
    readout: str,
    size: float,
    colours: np.ndarray | None,
) -> None:
    colour = colours
    if colour is None:
        of_readout = COLOURS.get(readout, COLOURS["sampled"])
        colour = np.array(of_readout) / 255
    number = max(len(samples), 1)
    shrink = min(1, LARGE_MARKER_SAMPLES / number)
    marker = max(size * shrink, 1.5)
    axes.scatter(*samples.T, s=marker, color=colour, depthshade=False, zorder=2)


def matrix_figure(dense: Tensor, gram: Tensor, title: str) -> Figure:
    """Draw S and SᵀS as heat maps on one colour scale (the paper's figure of S).

    Args:
        dense: ``(N, M)``. Rows are sorted by their strongest column, so that an ideal matrix
            shows as a diagonal. Of more than ``MATRIX_ROWS`` rows, the largest entries of
            consecutive ones are drawn.
        gram: ``(M, M)``.
        title: the cloud and sampler of the matrix.
    """
    values = dense.detach().cpu()
    points, columns = values.shape
    strongest = values.argmax(1)
    # An entry is at most 1, so the column decides, and the entry where columns are equal.
    places = strongest.mul(2.0).sub(values.amax(1))
    in_order = values[places.argsort()]
    rows = adaptive_max_pool1d(in_order.T, min(MATRIX_ROWS, points)).T
    extent = (-0.5, columns - 0.5, points - 0.5, -0.5)
    scale: dict[str, Any] = {"vmin": 0, "vmax": 1, "cmap": "viridis"}
    figure = new_figure(9, 4.4)
    left, right = figure.subplots(1, 2, gridspec_kw={"wspace": 0.08})
    left.imshow(rows.numpy(), aspect="auto", interpolation="nearest", extent=extent, **scale)
    left.set(title="S (points sorted by strongest column)", xlabel="column", ylabel="point")
    image = right.imshow(gram.detach().cpu().numpy(), **scale)
    right.set(title="SᵀS", xlabel="column", ylabel="column")
    figure.colorbar(image, ax=[left, right], shrink=0.8)
    figure.suptitle(title, fontsize=10)
    return figure


def upright(points: Tensor | np.ndarray) -> np.ndarray:
    """Turn y-up clouds into matplotlib's z-up ones."""
    if isinstance(points, Tensor):
        points = points.detach().cpu().float().numpy()
    x = points[..., 0]
    y = points[..., 1]
    z = points[..., 2]
    return np.stack([x, -z, y], -1)


def frame_cloud(axes: Axes3D, cloud: np.ndarray) -> None:
    """Fit the axes to a cloud with equal scales, and hide them."""
    low = cloud.min(0)
    high = cloud.max(0)
    x, y, z = (high + low) / 2
    longest = np.ptp(cloud, axis=0).max()
    reach = longest / 2 or 1.0
    axes.set_xlim(x - reach, x + reach)
    axes.set_ylim(y - reach, y + reach)
    axes.set_zlim(z - reach, z + reach)
    axes.set_box_aspect((1, 1, 1), zoom=1.3)
    axes.set_axis_off()
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_visible(False)  # matplotlib measures the ticks of hidden axes, too
    axes.view_init(**VIEWS["y"])


def view_upright(figure: Figure, up: str) -> None:
    """Turn the view of all clouds of a figure, which are drawn with y up, to their vertical axis.

    Args:
        figure: of this module or of ``task_results``.
        up: the vertical axis, ``x``, ``y`` or ``z``.
    """
    for axes in figure.axes:
        if isinstance(axes, Axes3D):
            axes.view_init(**VIEWS[up])


def to_y_up(points: Tensor, up: str) -> Tensor:
    """Rotate points ``(..., 3)`` so that their vertical axis ``x``, ``y`` or ``z`` becomes y."""
    x, y, z = points.unbind(-1)
    turned = {
        "x": (-y, x, z),
        "y": (x, y, z),
        "z": (x, z, -y),
    }
    return torch.stack(turned[up], -1)


def thinned(points: Any) -> Any:
    """Return every k-th point of clouds ``(..., N, 3)`` above ``MAX_INPUT_POINTS``."""
    number = points.shape[-2]
    step = math.ceil(number / MAX_INPUT_POINTS)
    return points[..., :: max(step, 1), :]


def save_clouds(
    path: Path,
    points: Tensor,
    sampled: Mapping[str, Tensor],
    titles: Sequence[str],
) -> None:
    """Write clouds and their samples.

    Args:
        path: the file.
        points: ``(K, N, 3)`` input, y up.
        sampled: ``(K, M, 3)`` by readout.
        titles: one per cloud.
    """
    arrays: dict[str, Any] = {TITLES: np.array(titles)}
    clouds = {INPUT: thinned(points), **sampled}
    for name, cloud in clouds.items():
        arrays[name] = cloud.detach().cpu().float().numpy()
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def load_clouds(path: Path) -> tuple[list[str], dict[str, NDArray[np.float32]]]:
    """Read a file of ``save_clouds``.

    Returns:
        The titles, and ``(K, points, 3)`` by name, ``input`` first.

    Raises:
        UserError: the file is missing or not of this format.
    """
    try:
        arrays = load_npz(path)
        titles = [str(title) for title in arrays.pop(TITLES)]
        clouds = {INPUT: arrays.pop(INPUT), **arrays}
        if not titles or not _are_clouds(clouds, len(titles)):
            raise ValueError("expected finite clouds and samples for each title")
    # Numpy raises TypeError for other kinds of numbers, SystemError for odd characters.
    except (KeyError, SystemError, TypeError, ValueError) as error:
        raise UserError(f"{path}: cannot read saved clouds: {error}.") from None
    return titles, clouds


def _are_clouds(clouds: Mapping[str, NDArray[Any]], number: int) -> bool:
    """Return whether the input and at least one sample are finite ``(number, points, 3)``."""
    for cloud in clouds.values():
        has_shape = cloud.shape[::2] == (number, 3)
        if not has_shape or not np.isfinite(cloud).all():
            return False
    return len(clouds) >= 2
