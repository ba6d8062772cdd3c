"""Creating and saving matplotlib figures, without pyplot's global state."""

import io
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.axes3d import Axes3D
from PIL import Image

from mops_lightning.filesystem import atomic_write

MAX_PNG_BYTES = 300_000
MAX_SVG_BYTES = 150_000


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
    """Write a figure as PNG of at most ``MAX_PNG_BYTES``, completely or not at all.

    Figures above the limit get a palette of 256 colours and, if that is not enough, a lower
    resolution.

    Args:
        figure: what to write.
        path: the file.
        dpi: resolution of figures below the limit.
    """
    data = _png(figure, dpi)
    if len(data) > MAX_PNG_BYTES:
        data = _with_palette(data)
    while len(data) > MAX_PNG_BYTES:
        dpi *= 0.8
        data = _with_palette(_png(figure, dpi))
    with atomic_write(path) as temporary:
        temporary.write_bytes(data)
    return path


def save_svg(figure: Figure, path: Path) -> bool:
    """Write a figure as SVG unless that exceeds ``MAX_SVG_BYTES``; then delete an earlier file.

    Returns:
        Whether the file was written.
    """
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", dpi=150, metadata={"Date": None})
    if buffer.tell() > MAX_SVG_BYTES:
        path.unlink(missing_ok=True)
        return False
    with atomic_write(path) as temporary:
        temporary.write_bytes(buffer.getvalue())
    return True


def _png(figure: Figure, dpi: float) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def _with_palette(png: bytes) -> bytes:
    buffer = io.BytesIO()
    image = Image.open(io.BytesIO(png)).convert("RGB")
    image.quantize(256, dither=Image.Dither.NONE).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()
