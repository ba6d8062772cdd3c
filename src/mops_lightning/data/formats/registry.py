"""The file formats, and reading and writing a file of any of them."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from mops_lightning.data.formats import e57, las, leica, numpy_files, pcd, ply, scans, splats, text
from mops_lightning.data.formats.area import Area
from mops_lightning.data.formats.cloud_file import CloudFile
from mops_lightning.data.formats.guard import (
    BadCloudError,
    CannotHoldError,
    WholeOnlyError,
    reading,
)
from mops_lightning.data.formats.mesh import SUFFIXES as MESHES
from mops_lightning.data.formats.mesh import mesh_vertices, sample_mesh
from mops_lightning.data.formats.table import Table, TableParts
from mops_lightning.errors import one_line, printable
from mops_lightning.filesystem import atomic_write

READERS: dict[str, Callable[[Path], Table | None]] = {
    ".ply": ply.read,
    ".pcd": pcd.read,
    ".las": las.read,
    ".laz": las.read,
    ".bin": scans.read,
    ".npy": numpy_files.read_npy,
    ".npz": numpy_files.read_npz,
    ".xyz": text.read,
    ".txt": text.read,
    ".e57": e57.read,
    ".pts": leica.read_pts,
    ".ptx": leica.read_ptx,
    ".spz": splats.read_spz,
    ".splat": splats.refuse_splat,
}
"""Readers of clouds; they return None for a mesh."""

WRITERS: dict[str, Callable[[Path, Table], list[str] | None]] = {
    ".ply": ply.write,
    ".pcd": pcd.write,
    ".las": las.write,
    ".laz": las.write,
    ".copc.laz": las.write_copc,
    ".bin": scans.write,
    ".npy": numpy_files.write_npy,
    ".npz": numpy_files.write_npz,
    ".xyz": text.write,
    ".txt": text.write,
}
"""Writers of clouds; they return in words what the file does not hold, if anything."""

PART_WRITERS: dict[str, Callable[[Path, TableParts], list[str] | None]] = {
    ".ply": ply.write_parts,
    ".las": las.write_parts,
    ".laz": las.write_parts,
    ".copc.laz": las.write_copc_parts,
}
"""Formats that are written part by part."""

CHUNKED: dict[str, Callable[[Path], CloudFile]] = {
    ".npy": numpy_files.locate_npy,
    ".bin": scans.locate,
    ".ply": ply.locate,
    ".las": las.locate,
    ".laz": las.locate,
}
"""Formats whose rows can be read in any range."""

READABLE = tuple(dict.fromkeys((*READERS, *MESHES)))


def read(
    path: Path,
    surface: int,
    seed: int,
    area: Area | None = None,
    columns: Sequence[str] | None = None,
    vertices: bool = False,
) -> Table:
    """Read a cloud, or sample a mesh.

    Args:
        path: a file that ends in one of ``READABLE``.
        surface: number of points to sample from a mesh's surface, uniform by area.
        seed: of these.
        area: the part of the file to read.
        columns: names of the columns of .bin files; None: those that their names imply.
        vertices: take the vertices of a mesh, instead of points on its surface.

    Raises:
        UserError: the file is missing or broken.
    """
    if area is not None:
        try:
            return open_cloud_file(path, area, columns).read_all()
        except WholeOnlyError:
            return area.clip(read(path, surface, seed, None, columns, vertices), path)
    suffix = path.suffix.lower()
    if suffix not in READABLE:
        raise BadCloudError(f"{path} must end in {', '.join(READABLE)}.")
    with reading(path):
        table = read_points(path, columns)
        if table is not None:
            return table
        data = path.read_bytes()
        if not vertices:
            return sample_mesh(path, data, surface, seed)
        if suffix == ".ply":
            return ply.read_vertices(path)
        return mesh_vertices(path, data)


def read_points(path: Path, columns: Sequence[str] | None = None) -> Table | None:
    """Read a cloud; None for a mesh. See ``read``."""
    suffix = path.suffix.lower()
    if suffix == ".bin":
        return scans.read(path, columns)
    if suffix not in READERS:
        return None
    return READERS[suffix](path)


def suffix_of(path: Path) -> str:
    """Return the end of a name that says which format a written file has."""
    name = path.name.lower()
    if name.endswith(".copc.laz"):
        return ".copc.laz"
    return path.suffix.lower()


def write(path: Path, table: Table | TableParts) -> None:
    """Write a file that ends in one of ``WRITERS``, completely or not at all.

    A line says what the format does not hold.

    Raises:
        BadCloudError: the format cannot hold the table, or the file cannot be written.
    """
    suffix = suffix_of(path)
    notes: list[str] | None = None
    try:
        with atomic_write(path) as temporary:
            if isinstance(table, TableParts):
                notes = PART_WRITERS[suffix](temporary, table)
            elif path.name.lower().endswith(scans.NUSCENES_SUFFIX):
                notes = scans.write(temporary, table, scans.NUSCENES)
            else:
                notes = WRITERS[suffix](temporary, table)
    except CannotHoldError as error:
        raise BadCloudError(f"OUT: {path}: {error}") from None
    except OSError as error:
        raise BadCloudError(
            f"OUT: cannot write {path} ({one_line(error)}). Free space, or give another OUT."
        ) from None
    _say(path, table, notes or [])


def _say(path: Path, table: Table | TableParts, notes: list[str]) -> None:
    """Print in one line what a written file does not hold of its source."""
    if table.form.left_out:
        notes = [*notes, f"without {', '.join(table.form.left_out)}"]
    if notes:
        print(printable(f"{path}: {'; '.join(notes)}"))


def open_cloud_file(
    path: Path, area: Area | None = None, columns: Sequence[str] | None = None
) -> CloudFile:
    """Open a file whose rows can be read in any range.

    Args:
        path: the file.
        area: the part of it to read.
        columns: see ``read``.

    Raises:
        WholeOnlyError: the file is of a kind that is read as a whole only.
        BadCloudError: the file is missing or broken.
    """
    suffix = path.suffix.lower()
    if suffix not in CHUNKED:
        raise WholeOnlyError(f"{path}: --chunk works with {', '.join(CHUNKED)}.")
    with reading(path):
        if suffix == ".bin":
            file = scans.locate(path, columns)
        else:
            file = CHUNKED[suffix](path)
        if area is None:
            return file
        if suffix in (".las", ".laz"):
            return las.locate_area(file, area)
        return replace(file, area=area)
