"""The file formats, and reading and writing a file of any of them."""

from collections.abc import Callable
from pathlib import Path

from mops_lightning.data.formats import arrays, las, pcd, ply, text
from mops_lightning.data.formats.guard import BadCloudError, WholeOnlyError, reading
from mops_lightning.data.formats.mesh import SUFFIXES as MESHES
from mops_lightning.data.formats.mesh import sample_mesh
from mops_lightning.data.formats.table import Area, CloudFile, Table, TableParts
from mops_lightning.errors import one_line
from mops_lightning.filesystem import atomic_write

READERS: dict[str, Callable[[Path], Table | None]] = {
    ".ply": ply.read, ".pcd": pcd.read, ".las": las.read, ".laz": las.read,
    ".bin": arrays.read_kitti, ".npy": arrays.read_npy, ".npz": arrays.read_npz,
    ".xyz": text.read, ".txt": text.read,
}  # fmt: skip
"""Readers of clouds; they return None for a mesh."""

WRITERS: dict[str, Callable[[Path, Table], None]] = {
    ".ply": ply.write, ".pcd": pcd.write, ".las": las.write, ".laz": las.write,
    ".bin": arrays.write_kitti, ".npy": arrays.write_npy, ".npz": arrays.write_npz,
    ".xyz": text.write, ".txt": text.write,
}  # fmt: skip

PART_WRITERS: dict[str, Callable[[Path, TableParts], None]] = {
    ".ply": ply.write_parts, ".las": las.write_parts, ".laz": las.write_parts,
}  # fmt: skip
"""Formats that are written part by part."""

CHUNKED: dict[str, Callable[[Path], CloudFile]] = {
    ".npy": arrays.locate_npy, ".bin": arrays.locate_kitti, ".ply": ply.locate,
    ".las": las.locate, ".laz": las.locate,
}  # fmt: skip
"""Formats whose rows can be read in any range."""

READABLE = tuple(dict.fromkeys((*READERS, *MESHES)))


def read(path: Path, surface: int, seed: int, area: Area | None = None) -> Table:
    """Read a cloud, or sample a mesh.

    Args:
        path: a file that ends in one of ``READABLE``.
        surface: number of points to sample from a mesh's surface, uniform by area.
        seed: of these.
        area: the part of the file to read.

    Raises:
        UserError: the file is missing or broken.
    """
    if area is not None:
        try:
            return open_cloud_file(path, area).read_all()
        except WholeOnlyError:
            return area.clip(read(path, surface, seed), path)
    suffix = path.suffix.lower()
    if suffix not in READABLE:
        raise BadCloudError(f"{path} must end in {', '.join(READABLE)}.")
    with reading(path):
        table = READERS[suffix](path) if suffix in READERS else None
        if table is not None:
            return table
        points, normals = sample_mesh(path, path.read_bytes(), surface, seed)
    return Table(points, dict(zip(("nx", "ny", "nz"), normals.T, strict=True)))


def write(path: Path, table: Table | TableParts) -> None:
    """Write a file that ends in one of ``WRITERS``, completely or not at all.

    Raises:
        BadCloudError: the format cannot hold the table, or the file cannot be written.
    """
    try:
        with atomic_write(path) as temporary:
            if isinstance(table, TableParts):
                PART_WRITERS[path.suffix.lower()](temporary, table)
            else:
                WRITERS[path.suffix.lower()](temporary, table)
    except OSError as error:
        raise BadCloudError(
            f"OUT: cannot write {path} ({one_line(error)}). Free space, or give another OUT."
        ) from None


def open_cloud_file(path: Path, area: Area | None = None) -> CloudFile:
    """Open a file whose rows can be read in any range.

    Args:
        path: the file.
        area: the part of it to read.

    Raises:
        WholeOnlyError: the file is of a kind that is read as a whole only.
        BadCloudError: the file is missing or broken.
    """
    suffix = path.suffix.lower()
    if suffix not in CHUNKED:
        raise WholeOnlyError(f"{path}: --chunk works with {', '.join(CHUNKED)}.")
    with reading(path):
        file = CHUNKED[suffix](path)
        return file if area is None else las.locate_area(file, area)
