"""Laser scans without a header: .bin of KITTI, .pcd.bin of nuScenes, and their labels (.label)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.cloud_file import CloudFile, binary_file
from mops_lightning.data.formats.columns import changed_numbers
from mops_lightning.data.formats.guard import BadCloudError, CannotHoldError
from mops_lightning.data.formats.table import Column, Table

KITTI = ("x", "y", "z", "intensity")
NUSCENES = ("x", "y", "z", "intensity", "ring")

NUSCENES_SUFFIX = ".pcd.bin"

OTHER_LENGTHS = (3, 5, 6, 7, 8)
"""Numbers per point in other files that end in .bin."""

TOLERANCE = 1e-6
"""Largest distance by which float32 may move a point, as a share of the extent of the cloud."""

LOOKED_AT = 100_000
"""So many numbers of a file show whether they fit its columns."""

CLEARLY_SMOOTHER = 0.7
"""Ratio of mean differences between points, below which another number of columns fits better."""

FEW_POINTS = 32
"""Fewer points do not show how many columns they have."""


@dataclass(frozen=True)
class ScanForm:
    """The columns of a scan that a user has named; None: those that the file's name implies."""

    names: tuple[str, ...] | None


def read(path: Path, names: Sequence[str] | None = None) -> Table:
    """Read a scan, with the classes and instances of a SemanticKITTI .label file beside it.

    Args:
        path: the file.
        names: of its columns; None: those of KITTI, or of nuScenes in a .pcd.bin file.

    Raises:
        BadCloudError: the file does not have these columns.
    """
    scan = locate(path, names)
    return scan.parse(path, range(scan.number))


def locate(path: Path, names: Sequence[str] | None = None) -> CloudFile:
    """Find the rows of a scan; see ``read``."""
    if names is None:
        chosen = assumed_columns(path)
        given = None
    else:
        chosen = tuple(names)
        given = chosen
    kind = np.dtype([(name, "<f4") for name in chosen])
    length = path.stat().st_size
    if not length or length % kind.itemsize:
        columns = ", ".join(chosen)
        example = ",".join(NUSCENES)
        raise BadCloudError(
            f"{path}: {length} bytes are not rows of {len(chosen)} float32 "
            f"({columns}). Name the columns of the file, such as --columns "
            f"{example}."
        )
    number = length // kind.itemsize
    if names is None:
        _check_values(path, chosen)
    parse_numbers = binary_file(path, number, kind).parse
    labels = _label_file(path)
    if labels is not None:
        bytes_of_labels = labels.stat().st_size
        if bytes_of_labels != 4 * number:
            raise BadCloudError(
                f"{labels} has {bytes_of_labels} bytes, not 4 for each of the {number} points of "
                f"{path}."
            )
    parse = partial(_parse, parse_numbers, labels, ScanForm(given))
    return CloudFile(path, number, parse)


def _parse(
    parse_numbers: Callable[[Path, range], Table],
    labels: Path | None,
    layout: ScanForm,
    path: Path,
    rows: range,
) -> Table:
    table = parse_numbers(path, rows)
    form = replace(table.form, layout=layout)
    if labels is None:
        return replace(table, form=form)
    packed = np.fromfile(labels, "<u4", len(rows), offset=4 * rows.start)
    classes = {
        "label": (packed & 0xFFFF).astype(np.uint16),
        "instance": (packed >> 16).astype(np.uint16),
    }
    columns = {**table.columns, **classes}
    return replace(table, columns=columns, form=form)


def assumed_columns(path: Path) -> tuple[str, ...]:
    """Return the columns of a file by its name."""
    if path.name.lower().endswith(NUSCENES_SUFFIX):
        return NUSCENES
    return KITTI


def _label_file(path: Path) -> Path | None:
    """Return the labels of a scan: beside it, or in the folder ``labels`` beside ``velodyne``."""
    beside = path.with_suffix(".label")
    places = [beside]
    if path.parent.name == "velodyne":
        places.append(path.parent.parent / "labels" / beside.name)
    return next((place for place in places if place.is_file()), None)


def _check_values(path: Path, names: tuple[str, ...]) -> None:
    """Reject a file whose numbers do not look like the columns that it should have."""
    width = len(names)
    whole_rows = LOOKED_AT // width
    numbers = np.fromfile(path, "<f4", whole_rows * width)
    rows = numbers.reshape(-1, width)
    with np.errstate(invalid="ignore"):
        intensity = rows[:, names.index("intensity")]
        has_negative = bool((intensity < 0).any())
    if has_negative or _fits_others_better(numbers, width):
        columns = ", ".join(names)
        example = ",".join(NUSCENES)
        raise BadCloudError(
            f"{path} does not look like rows of {columns}. Name its columns, such as "
            f"--columns {example}; if these are right: --columns {','.join(names)}."
        )


def _fits_others_better(numbers: NDArray[np.float32], width: int) -> bool:
    """Return whether points with another number of columns would differ much less."""
    finite = numbers[np.isfinite(numbers)]
    values = np.arcsinh(finite.astype(np.float64))
    if len(values) < FEW_POINTS * width:
        return False
    assumed = _mean_difference(values, width)
    others = [_mean_difference(values, other) for other in OTHER_LENGTHS if other != width]
    return min(others) < CLEARLY_SMOOTHER * assumed


def _mean_difference(values: NDArray[np.float64], width: int) -> float:
    """Return the mean difference of numbers that would be one column of neighbouring points."""
    differences = values[width:] - values[:-width]
    return float(np.abs(differences).mean())


def write(path: Path, table: Table, names: tuple[str, ...] = KITTI) -> list[str]:
    """Write float32 columns: those that a user has named for a scan that was read, or others.

    Args:
        path: the file.
        table: without an intensity, or another one of the columns, it is 0.
        names: the columns otherwise.

    Returns:
        Columns that are left out, and numbers that float32 changes.

    Raises:
        CannotHoldError: float32 would move the points by more than ``TOLERANCE``.
    """
    _check_digits(table.points)
    layout = table.form.layout
    chosen = names
    if isinstance(layout, ScanForm) and layout.names is not None:
        chosen = layout.names
    coordinates = zip("xyz", table.points.T, strict=True)
    available: dict[str, Column] = {**dict(coordinates), **table.columns}
    rows = np.zeros((len(table.points), len(chosen)), "<f4")
    notes = []
    for place, name in enumerate(chosen):
        column = available.get(name)
        if column is None:
            continue
        with np.errstate(over="ignore"):
            rows[:, place] = column
        if changed := changed_numbers(column, np.dtype("f4")):
            notes.append(f"{changed:,} numbers of {name} are rounded to float32")
    left_out = [name for name in table.columns if name not in chosen]
    if left_out:
        lost = ", ".join(left_out)
        notes.append(f"no room for {lost}: .bin holds {', '.join(chosen)}")
    rows.tofile(path)
    return notes


def _check_digits(points: NDArray[np.float64]) -> None:
    finite = points[np.isfinite(points).all(axis=1)]
    if not len(finite):
        return
    with np.errstate(over="ignore"):
        rounded = finite.astype(np.float32)
        moved = np.abs(rounded - finite).max()
    extent = np.ptp(finite, axis=0).max()
    if moved > TOLERANCE * extent:
        raise CannotHoldError(
            ".bin holds float32, which would move these points, far from the origin, by "
            f"up to {moved:.3g}. Write .ply, .npy or .las."
        )
