"""PLY files: ascii and binary are read, binary is written."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.cloud_file import CloudFile, binary_file
from mops_lightning.data.formats.columns import (
    fitting_type,
    floating,
    from_columns,
    in_native_order,
    to_rows,
    unique_names,
)
from mops_lightning.data.formats.guard import BadCloudError, WholeOnlyError
from mops_lightning.data.formats.ply_elements import (
    KINDS,
    LONGEST_HEADER,
    Element,
    Header,
    Lists,
    Values,
    read_elements,
    read_header,
)
from mops_lightning.data.formats.splats import read_compressed_ply
from mops_lightning.data.formats.table import Column, Form, Table, TableParts

TYPES = {kind: name for name, kind in KINDS.items() if not name[-1].isdigit()}
"""PLY's names of data types."""

INDICES = ("vertex_indices", "vertex_index")
"""Names of the list of a face's corners."""


@dataclass(frozen=True)
class PlyMesh:
    """A mesh of triangles.

    Attributes:
        table: its vertices.
        faces: ``(F, 3)`` rows of vertices; polygons are cut into triangles.
        face_columns: ``(F,)`` numbers of the faces.
        left_out: names of lists and elements besides.
    """

    table: Table
    faces: NDArray[np.int64]
    face_columns: dict[str, Column]
    left_out: tuple[str, ...]


def read(path: Path) -> Table | None:
    """Read the vertices with all their properties; None for a mesh, which has faces as well.

    Raises:
        BadCloudError: the file is broken or ends before its last vertex.
    """
    data = path.read_bytes()
    header = read_header(data[:LONGEST_HEADER])
    if _is_compressed(header):
        return read_compressed_ply(path)
    if any(_is_faces(element) for element in header.elements):
        return None
    return _vertices(path, header, read_elements(data, header))


def read_vertices(path: Path) -> Table:
    """Read the vertices with all their properties, also of a mesh; see ``read``."""
    data = path.read_bytes()
    header = read_header(data[:LONGEST_HEADER])
    return _vertices(path, header, read_elements(data, header))


def parse_mesh(data: bytes, path: Path) -> PlyMesh:
    """Parse a mesh.

    Args:
        data: content of the file.
        path: of the file, for errors.

    Raises:
        ValueError: the file is broken, or its faces have no list of corners.
    """
    header = read_header(data[:LONGEST_HEADER])
    elements = read_elements(data, header)
    table = _vertices(path, header, elements)
    lists: dict[str, Lists] = {}
    numbers: dict[str, Column] = {}
    for name, values in elements.get("face", {}).items():
        if isinstance(values, Lists):
            lists[name] = values
        else:
            numbers[name] = values
    corners = _corners(lists)
    if corners is None:
        no_faces = np.empty((0, 3), np.int64)
        return PlyMesh(table, no_faces, {}, table.form.left_out)
    faces, rows = _triangles(corners)
    columns = {name: in_native_order(values)[rows] for name, values in numbers.items()}
    left_out = tuple(name for name in table.form.left_out if name != "element face")
    return PlyMesh(table, faces, columns, left_out)


def _corners(lists: dict[str, Lists]) -> Lists | None:
    """Return the corners of the faces: the list with a usual name, or else the first one."""
    for name in (*INDICES, *lists):
        if name in lists:
            return lists[name]
    return None


def _is_compressed(header: Header) -> bool:
    """Return whether the vertices are packed splats."""
    names = {part.name for element in header.elements for part in element.properties}
    return "packed_position" in names


def _is_faces(element: Element) -> bool:
    return element.name == "face" and element.number > 0 and element.has_lists


def _triangles(polygons: Lists) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Cut polygons into triangles ``(F, 3)`` from their first corners; and the row of each."""
    triangles = [np.empty((0, 3), np.int64)]
    rows = [np.empty(0, np.int64)]
    for of_length, corners in polygons.by_length():
        whole = corners.astype(np.int64)
        for second in range(1, corners.shape[1] - 1):
            corners_of_triangle = [0, second, second + 1]
            triangles.append(whole[:, corners_of_triangle])
            rows.append(of_length)
    of_face = np.concatenate(rows)
    order = of_face.argsort(kind="stable")
    ordered = np.concatenate(triangles)[order]
    return ordered, of_face[order]


def _vertices(path: Path, header: Header, elements: dict[str, dict[str, Values]]) -> Table:
    """Return the table of the element with the points; lists and other elements are left out."""
    points = _points(path, header)
    if points.number < 1:
        raise BadCloudError(f"{path} holds no points.")
    columns = {}
    left_out = []
    for name, values in elements[points.name].items():
        if isinstance(values, Lists):
            left_out.append(name)
        else:
            columns[name] = values
    for element in header.elements:
        if element.name != points.name and element.number > 0:
            left_out.append(f"element {element.name}")
    table = from_columns(columns, path)
    form = Form(table.form.coordinates, left_out=tuple(left_out))
    return replace(table, form=form)


def _points(path: Path, header: Header) -> Element:
    """Return the element ``vertex``, or else the first one with x, y and z.

    Raises:
        BadCloudError: there is none.
    """
    named = [element for element in header.elements if element.name == "vertex"]
    for element in (*named, *header.elements):
        numbers = [part for part in element.properties if part.count is None]
        names = {part.name.lower() for part in numbers}
        if {"x", "y", "z"} <= names:
            return element
    found = ", ".join(element.name for element in header.elements) or "none"
    raise BadCloudError(f"{path} has no element with x, y and z. Its elements: {found}.")


def write(path: Path, table: Table) -> None:
    """Write binary PLY with the data types of the table; see ``write_parts``."""
    write_parts(path, TableParts.whole(table))


def write_parts(path: Path, table: TableParts) -> None:
    """Write binary PLY part by part.

    Raises:
        CannotHoldError: a column has numbers that no data type of PLY holds.
    """
    examples = unique_names(Table(table.corners, table.columns))
    kinds = dict.fromkeys("xyz", floating(table.coordinates))
    for name, column in examples.items():
        kinds[name] = fitting_type(name, column, TYPES, ".ply")
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {table.number}",
    ]
    for name, kind in kinds.items():
        type_name = TYPES[kind.str[1:]]
        lines.append(f"property {type_name} {name}")
    lines.append("end_header\n")
    with path.open("wb") as file:
        file.write("\n".join(lines).encode())
        for part in table.parts:
            coordinates = zip("xyz", part.points.T, strict=True)
            columns: dict[str, Column] = dict(coordinates)
            columns |= unique_names(part)
            typed = {}
            for name, column in columns.items():
                typed[name] = column.astype(kinds[name])
            file.write(to_rows(typed).tobytes())


def locate(path: Path) -> CloudFile:
    """Find the vertices of a binary PLY file.

    Raises:
        BadCloudError: the file is broken, a mesh, or its vertices are not rows of fixed length.
    """
    with path.open("rb") as file:
        header = read_header(file.read(LONGEST_HEADER))
    if header.is_ascii:
        raise WholeOnlyError(f"{path}: --chunk needs binary PLY.")
    if any(_is_faces(element) for element in header.elements):
        raise WholeOnlyError(f"{path} is a mesh: --chunk needs a cloud.")
    if _is_compressed(header):
        raise WholeOnlyError(f"{path} is a compressed PLY, which --chunk does not read.")
    points = _points(path, header)
    offset = header.end
    for element in header.elements:
        if element.has_lists:
            raise WholeOnlyError(
                f"{path}: --chunk needs vertices without lists, and no lists before them."
            )
        if element is points:
            break
        offset += element.row_type().itemsize * element.number
    return binary_file(path, points.number, points.row_type(), offset)
