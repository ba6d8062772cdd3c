"""Which file formats can be read and written, and by what."""

from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.mesh_io import SUFFIXES as MESHES
from mops_lightning.downsample import las, pcd
from mops_lightning.downsample.table import BadCloudError, Column, Table, from_array

PLY_TYPES = {
    "f4": "float", "f8": "double", "i1": "char", "u1": "uchar",
    "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint",
}  # fmt: skip


def read_text(path: Path) -> Table:
    """Read rows of numbers between blanks, commas or semicolons, with or without a head line."""
    text = path.read_text(encoding="latin-1")
    lines = [line for line in text.splitlines() if line.strip() and line.strip()[0] not in "#/"]
    if not lines:
        raise BadCloudError(f"{path} is empty.")
    comma = next((mark for mark in ",;" if mark in lines[0]), None)
    notes = [line.strip().lstrip("#/ ").split(comma) for line in text.splitlines()]
    width = len(lines[0].split(comma))
    # A head line, perhaps behind a comment sign: as many words as columns, x, y and z among them.
    heads = [words for words in notes[:20] if len(words) == width and {"x", "y", "z"} <= {*words}]
    names = [word.strip() for word in heads[0]] if heads else []
    try:
        [float(word) for word in lines[0].split(comma)]
    except ValueError:
        lines.pop(0)
    try:
        array = np.loadtxt(lines, delimiter=comma, ndmin=2)
    except ValueError as error:
        if len(lines) > 1 and len(lines[0].split(comma)) == 1:  # the XYZ of chemists: a count first
            return _numbers(np.loadtxt(lines[1:], delimiter=comma, ndmin=2), path)
        raise BadCloudError(f"{path} is broken: {error}.") from None
    if names:
        return from_array(array, names, path)
    return _numbers(array, path)


def write_text(path: Path, table: Table) -> None:
    """Write ``x y z`` and the columns, blanks between, with all digits that count."""
    columns = [*table.points.T, *table.columns.values()]
    kinds = ["%.9g" if c.dtype.kind == "f" else "%d" for c in columns]
    kinds[:3] = ["%.10g"] * 3
    named = [name for name in table.columns if not name.startswith("column_")]
    head = " ".join(["x", "y", "z", *table.columns]) if named else ""
    np.savetxt(path, _structured(columns), fmt=kinds, header=head, comments="# ")


def read_npy(path: Path) -> Table:
    """Read one array: ``(N, K)`` numbers, x, y and z first, or named fields."""
    array = _loaded(path)
    if array.dtype.names:
        return from_array(array, list(array.dtype.names), path)
    return _numbers(array, path)


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
        raise BadCloudError(f"{path} has no array named points; it has {', '.join(names)}.")
    table = _numbers(arrays[chosen[0]], path)
    columns: dict[str, Column] = dict(table.columns)
    for name in names:
        array = arrays[name]
        if name == chosen[0] or array.ndim == 0 or len(array) != len(table.points):
            continue
        if array.ndim == 1:
            columns[name] = array
        elif array.ndim == 2:
            columns |= {f"{name}_{place}": array[:, place] for place in range(array.shape[1])}
    return Table(table.points, columns)


def write_npz(path: Path, table: Table) -> None:
    """Write ``points`` and one array for every column."""
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, points=table.points, **table.columns)


def read_bin(path: Path) -> Table:
    """Read KITTI's scans: float32 x, y, z, intensity."""
    numbers = np.fromfile(path, "<f4")
    if not len(numbers) or len(numbers) % 4:
        raise BadCloudError(f"{path} is no KITTI scan: {len(numbers)} floats are no rows of four.")
    rows = numbers.reshape(-1, 4)
    return from_array(rows, ["x", "y", "z", "intensity"], path)


def write_bin(path: Path, table: Table) -> None:
    """Write KITTI's form; without an intensity it is 0."""
    intensity = table.columns.get("intensity", np.zeros(len(table.points)))
    path.write_bytes(np.column_stack([table.points, intensity]).astype("<f4").tobytes())


def read_ply(path: Path) -> Table | None:
    """Read the vertices with all their properties; None where there are faces as well."""
    from trimesh.exchange.ply import load_ply

    with np.errstate(all="ignore"):
        found: Any = load_ply(BytesIO(path.read_bytes()))
    if "faces" in found and len(found["faces"]):
        return None
    data = found["metadata"]["_ply_raw"]["vertex"]["data"]
    if isinstance(data, dict):  # of an ascii file: columns of shape (N, 1)
        flat = {name: np.asarray(column) for name, column in data.items()}
        flat = {n: c[:, 0] if c.ndim == 2 and c.shape[1] == 1 else c for n, c in flat.items()}
        flat = {name: column for name, column in flat.items() if column.ndim == 1}
        array = np.empty(len(next(iter(flat.values()))), [(n, c.dtype) for n, c in flat.items()])
        for name, column in flat.items():
            array[name] = column
        data = array
    return from_array(data, list(data.dtype.names), path)


def write_ply(path: Path, table: Table) -> None:
    """Write binary PLY: double coordinates where float32 would lose digits, else float."""
    single = table.points.astype("<f4")
    lost = np.abs(single - table.points).max()
    exact = not lost > 1e-6 * np.ptp(table.points, axis=0).max()
    axes = single if exact else table.points
    arrays = [*axes.T, *(column.astype(_ply_kind(column)) for column in table.columns.values())]
    rows = _structured(arrays)
    names = ["x", "y", "z", *(name.replace(" ", "_") for name in table.columns)]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    for name, array in zip(names, arrays, strict=True):
        lines.append(f"property {PLY_TYPES[array.dtype.str[1:]]} {name}")
    path.write_bytes("\n".join([*lines, "end_header\n"]).encode() + rows.tobytes())


def write_obj(path: Path, table: Table) -> None:
    """Write vertices alone."""
    np.savetxt(path, table.points, fmt="v %.10g %.10g %.10g")


def _ply_kind(column: Column) -> str:
    kind = column.dtype.kind
    if kind in "iub" and column.dtype.itemsize == 8:
        return "<i4"
    return {"b": "<u1", "f": f"<f{max(column.dtype.itemsize, 4)}"}.get(
        kind, column.dtype.newbyteorder("<").str
    )


def _structured(arrays: list[Column]) -> NDArray[Any]:
    rows = np.empty(len(arrays[0]), [(f"f{i}", a.dtype) for i, a in enumerate(arrays)])
    for i, array in enumerate(arrays):
        rows[f"f{i}"] = array
    return rows


def _numbers(array: NDArray[Any], path: Path) -> Table:
    if array.ndim != 2 or array.shape[1] < 3 or array.dtype.kind not in "fiu":
        raise BadCloudError(f"{path} must hold rows of x, y, z, got shape {array.shape}.")
    names = ["x", "y", "z", *(f"column_{place}" for place in range(3, array.shape[1]))]
    return from_array(array, names, path)


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
