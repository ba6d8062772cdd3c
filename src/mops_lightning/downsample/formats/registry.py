"""Which file formats can be read and written, and by what."""

import re
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.mesh_io import SUFFIXES as MESHES
from mops_lightning.downsample.formats import las, pcd
from mops_lightning.downsample.formats.chunks import PLY_KINDS, kitti
from mops_lightning.downsample.formats.table import (
    BadCloudError,
    Column,
    Table,
    column_names,
    coordinates,
    from_array,
    unique_names,
)

PLY_TYPES = {kind: name for name, kind in PLY_KINDS.items() if not name[-1].isdigit()}


def read_text(path: Path) -> Table:
    """Read rows of numbers between blanks, commas or semicolons, with or without a head line."""
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    lines = [re.split("#|//", line)[0].strip() for line in text.splitlines()]
    lines = [line for line in lines if line]
    if not lines:
        raise BadCloudError(f"{path} is empty.")
    mark = next((mark for mark in ",;" if mark in lines[-1]), None)
    if len(lines) > 1 and len(lines[0].split(mark)) == 1 and lines[0].isdigit():
        lines.pop(0)  # how many points there are
    if not any(map(_is_number, lines[0].split(mark))):
        lines.pop(0)  # names of the columns, or of something else
    try:
        array = np.loadtxt(lines, delimiter=mark, ndmin=2)
    except ValueError as error:
        raise BadCloudError(f"{path} is broken: {str(error).rstrip('.')}.") from None
    # A head line may stand behind a comment sign: as many words as columns, x, y, z among them.
    for line in text.lstrip("\ufeff").splitlines()[:20]:
        words = [word.strip() for word in line.strip().lstrip("#/ ").split(mark)]
        if len(words) == array.shape[1] and {"x", "y", "z"} <= {word.lower() for word in words}:
            return from_array(array, words, path)
    return _numbers(array, path)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def write_text(path: Path, table: Table) -> None:
    """Write ``x y z`` and the columns, blanks between, with all digits that count."""
    named = unique_names(table)
    columns = [*coordinates(table).T, *named.values()]
    plain = all(name.startswith("column_") for name in named)
    head = "" if plain else " ".join(["x", "y", "z", *named])
    kinds = [_digits(column) for column in columns]
    np.savetxt(path, _structured(columns), fmt=kinds, header=head, comments="# ")


def _digits(column: Column) -> str:
    if column.dtype.kind != "f":
        return "%d"
    short = column.dtype.itemsize <= 4 or np.array_equal(column.astype("f4"), column)
    return "%.9g" if short else "%.17g"


def read_npy(path: Path) -> Table:
    """Read one array: ``(N, K)`` numbers, x, y and z first, or named fields."""
    return _numbers(_loaded(path), path)


def write_npy(path: Path, table: Table) -> None:
    """Write ``(N, 3 + columns)`` float64."""
    with path.open("wb") as file:
        np.save(file, np.column_stack([table.points, *table.columns.values()]))


def read_npz(path: Path) -> Table:
    """Read the array ``points`` (or ``xyz``, ``pos``, or the only one); others are attributes."""
    arrays: Any = _loaded(path)
    names = list(arrays)
    chosen = [name for name in ("points", "xyz", "pos") if name in names] or names[:1]
    if not chosen or (len(names) > 1 and chosen == names[:1] and chosen[0] not in
                      ("points", "xyz", "pos")):  # fmt: skip
        raise BadCloudError(
            f"{path} has no array named points; it has {', '.join(names) or 'none at all'}."
        )
    table = _numbers(arrays[chosen[0]], path)
    columns: dict[str, Column] = dict(table.columns)
    for name in names:
        array = arrays[name]
        if name == chosen[0] or array.ndim == 0 or len(array) != len(table.points):
            continue
        if array.dtype.kind not in "fiub":
            continue
        if array.ndim == 1:
            columns[name] = array
        elif array.ndim == 2:
            columns |= {f"{name}_{place}": array[:, place] for place in range(array.shape[1])}
    return Table(table.points, columns)


def write_npz(path: Path, table: Table) -> None:
    """Write ``points`` and one array for every column."""
    named = unique_names(table)
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, points=table.points, **named)


def read_bin(path: Path) -> Table:
    """Read KITTI's scans: float32 x, y, z, intensity."""
    rows = kitti(path)
    return rows.raw(range(rows.number))


def write_bin(path: Path, table: Table) -> None:
    """Write KITTI's form, float32 alone; without an intensity it is 0."""
    axes = coordinates(table)
    if axes.dtype != np.float32:
        raise BadCloudError(
            f"{path}: .bin holds float32, which would move these points, far from the origin, by "
            "more than a millionth of their extent. Write .ply, .npy or .las."
        )
    intensity = table.columns.get("intensity", np.zeros(len(axes)))
    path.write_bytes(np.column_stack([axes, intensity]).astype("<f4").tobytes())


def read_ply(path: Path) -> Table | None:
    """Read the vertices with all their properties; None where there are faces as well."""
    from trimesh.exchange.ply import load_ply

    with np.errstate(all="ignore"):
        found: Any = load_ply(BytesIO(path.read_bytes()))
    if "faces" in found and len(found["faces"]):
        return None
    vertex = found["metadata"]["_ply_raw"]["vertex"]
    data, announced = vertex["data"], vertex["length"]
    if isinstance(data, dict):  # of an ascii file: columns of shape (N, 1)
        flat = {name: np.asarray(column) for name, column in data.items()}
        flat = {n: c[:, 0] if c.ndim == 2 and c.shape[1] == 1 else c for n, c in flat.items()}
        flat = {name: column for name, column in flat.items() if column.ndim == 1}
        array = np.empty(len(next(iter(flat.values()))), [(n, c.dtype) for n, c in flat.items()])
        for name, column in flat.items():
            array[name] = column
        data = array
    if len(data) < announced:
        raise BadCloudError(f"{path} is broken: it announces {announced} points, not {len(data)}.")
    return from_array(data, list(data.dtype.names), path)


def write_ply(path: Path, table: Table) -> None:
    """Write binary PLY: float coordinates, or double where float would lose digits."""
    named = unique_names(table)
    arrays = [
        *coordinates(table).T,
        *(column.astype(_ply_kind(column)) for column in named.values()),
    ]
    rows = _structured(arrays)
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    for name, array in zip(["x", "y", "z", *named], arrays, strict=True):
        lines.append(f"property {PLY_TYPES[array.dtype.str[1:]]} {name}")
    path.write_bytes("\n".join([*lines, "end_header\n"]).encode() + rows.tobytes())


def write_obj(path: Path, table: Table) -> None:
    """Write vertices alone."""
    axes = coordinates(table)
    np.savetxt(path, axes, fmt=f"v {' '.join([_digits(axes)] * 3)}")


def _ply_kind(column: Column) -> str:
    """Return the PLY type that holds a column: there are no whole numbers of 64 bits."""
    kind, size = column.dtype.kind, column.dtype.itemsize
    if kind in "iu" and size == 8:
        small = len(column) == 0 or (column.min() >= -(2**31) and column.max() < 2**31)
        return "<i4" if small else "<f8"
    if kind == "f":
        return f"<f{min(max(size, 4), 8)}"
    return "<u1" if kind == "b" else column.dtype.newbyteorder("<").str


def _structured(arrays: list[Column]) -> NDArray[Any]:
    rows = np.empty(len(arrays[0]), [(f"f{i}", a.dtype) for i, a in enumerate(arrays)])
    for i, array in enumerate(arrays):
        rows[f"f{i}"] = array
    return rows


def _numbers(array: NDArray[Any], path: Path) -> Table:
    return from_array(array, column_names(array, path), path)


def _loaded(path: Path) -> Any:
    try:
        found = np.load(path, allow_pickle=False)
        return dict(found) if path.suffix.lower() == ".npz" else found
    except (OSError, ValueError, EOFError) as error:
        raise BadCloudError(f"{path} is broken: {error}.") from None


READERS: dict[str, Callable[[Path], Table | None]] = {
    ".ply": read_ply, ".pcd": pcd.read, ".las": las.read, ".laz": las.read, ".bin": read_bin,
    ".npy": read_npy, ".npz": read_npz, ".xyz": read_text, ".txt": read_text,
}  # fmt: skip
WRITERS: dict[str, Callable[[Path, Table], None]] = {
    ".ply": write_ply, ".pcd": pcd.write, ".las": las.write, ".laz": las.write, ".bin": write_bin,
    ".npy": write_npy, ".npz": write_npz, ".xyz": write_text, ".txt": write_text,
    ".obj": write_obj,
}  # fmt: skip
READABLE = tuple(dict.fromkeys((*READERS, *MESHES)))
