"""Creating and saving matplotlib figures, without pyplot's global state."""

import io
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.axes3d import Axes3D
from PIL import Image

from mops_lightning.filesystem import atomic_write


def new_figure(width: float, height: float, layout: Any = "constrained") -> Figure:
    """Return an empty figure of a size in inches."""
    figure = Figure(figsize=(width, height), layout=layout)
    FigureCanvasAgg(figure)
    return figure


def cloud_axes(
    figure: Figure, rows: int, columns: int, row: int, column: int, title: str = "", label: str = ""
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


def save_figure(figure: Figure, path: Path, dpi: float = 110) -> Path:
    """Write a figure as PNG or SVG, completely or not at all.

    A PNG gets a palette of 256 colours, which makes it several times smaller.

    Args:
        figure: what to write.
        path: the file; its suffix gives the format.
        dpi: resolution of a PNG, and of the images in an SVG.
    """
    buffer = io.BytesIO()
    if path.suffix == ".svg":
        figure.savefig(buffer, format="svg", dpi=dpi, metadata={"Date": None})
    else:
        figure.savefig(buffer, format="png", dpi=dpi)
        image = Image.open(buffer).convert("RGB")
        buffer = io.BytesIO()
        image.quantize(256, dither=Image.Dither.NONE).save(buffer, "PNG", optimize=True)
    with atomic_write(path) as temporary:
        temporary.write_bytes(buffer.getvalue())
    return path
