"""Small LAS, LAZ and COPC files, and damage to the octree of the last."""

import io
import struct
from unittest import mock

import numpy as np

from mops_lightning.data.formats import las
from mops_lightning.data.formats.las import octree
from mops_lightning.data.formats.registry import WRITERS
from mops_lightning.data.formats.table import Table
from tests.support.mutations import NUMBERS, any_of

CHUNKS = ((0, 1), (1, 26), (26, 40))
"""First and last rows of the chunks of a LAZ file."""

COPC_HEADER = 429
"""Byte at which the numbers of COPC's header begin."""


def las_file(path, form):
    import laspy

    version = "1.2"
    if form > 5:
        version = "1.4"
    header = laspy.LasHeader(point_format=form, version=version)
    header.add_extra_dim(laspy.ExtraBytesParams("depth", "f4"))
    cloud = laspy.LasData(header)
    random = np.random.default_rng(form)
    cloud.x, cloud.y, cloud.z = random.uniform(0, 9, (3, 40))
    cloud.write(path)
    return path.read_bytes()


def laz_with_variable_chunks():
    """Return a LAZ file with chunks of 1, 25 and 14 points."""
    import laspy
    import lazrs

    header = laspy.LasHeader(point_format=6, version="1.4")
    rows = laspy.ScaleAwarePointRecord.zeros(40, header=header)
    random = np.random.default_rng(1)
    rows.x, rows.y, rows.z = random.uniform(0, 9, (3, 40))
    layout = lazrs.LazVlr.new_for_compression(6, 0, True)
    record = laspy.VLR("laszip encoded", 22204, "", layout.record_data())
    header.vlrs.append(record)
    header.update(rows)
    header.are_points_compressed = True
    file = io.BytesIO()
    header.write_to(file)
    compressor = lazrs.LasZipCompressor(file, layout)
    compressor.reserve_offset_to_chunk_table()
    for start, stop in CHUNKS:
        chunk = rows.array[start:stop].tobytes()
        compressor.compress_many(np.frombuffer(chunk, np.uint8))
        compressor.finish_current_chunk()
    compressor.done()
    return file.getvalue()


def copc_file(path, form):
    """Return a COPC file of three levels, with extra bytes."""
    random = np.random.default_rng(form)
    points = random.uniform(0, 9, (60, 3))
    depths = np.arange(60.0)
    template = path.with_name("b.las")
    las_file(template, form)
    header = las.read(template).header
    write = WRITERS[".copc.laz"]
    with mock.patch.object(octree, "LEAF", 10), mock.patch.object(octree, "GRID", 2):
        write(path, Table(points, {"depth": depths}, header))
    return path.read_bytes()


def changed_copc(random, content):
    """Change a number of a COPC file's octree, or of its table of chunks.

    Other changes rarely reach them.
    """
    content = bytearray(content)
    low, high = any_of(random, places_of_copc(content))
    number_of_changes = random.integers(1, 3)
    for _ in range(number_of_changes):
        width = int(random.choice([4, 8]))
        words = max((high - low) // 4, 1)
        start = low + 4 * int(random.integers(words))
        end = start + width
        number = any_of(random, NUMBERS)
        is_near_the_old_one = random.random() < 0.5
        if is_near_the_old_one:
            old = int.from_bytes(content[start:end], "little")
            number = old + int(random.integers(-9, 9))
        wrapped = number % 2 ** (8 * width)
        content[start:end] = wrapped.to_bytes(width, "little")
    return bytes(content)


def places_of_copc(content):
    """Return where COPC's header, the octree's page and the table of chunks begin and end."""
    page, size = struct.unpack_from("<2Q", content, COPC_HEADER + 40)
    (points,) = struct.unpack_from("<I", content, 96)
    (chunks,) = struct.unpack_from("<q", content, points)
    return [
        (COPC_HEADER, COPC_HEADER + 72),
        (page, page + size),
        (chunks, len(content)),
    ]
