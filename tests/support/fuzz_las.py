"""Small LAS, LAZ and COPC files, and damage to the octree of the last."""

import io
import struct
from unittest import mock

import numpy as np

from mops_lightning.data.formats import las
from mops_lightning.data.formats.las import octree
from mops_lightning.data.formats.registry import WRITERS
from mops_lightning.data.formats.table import Table
from tests.support.mutations import NUMBERS


def las_file(path, form):
    import laspy

    header = laspy.LasHeader(point_format=form, version="1.4" if form > 5 else "1.2")
    header.add_extra_dim(laspy.ExtraBytesParams("depth", "f4"))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = np.random.default_rng(form).uniform(0, 9, (3, 40))
    cloud.write(path)
    return path.read_bytes()


def laz_with_variable_chunks():
    """Return a LAZ file with chunks of 1, 25 and 14 points."""
    import laspy
    import lazrs

    header = laspy.LasHeader(point_format=6, version="1.4")
    rows = laspy.ScaleAwarePointRecord.zeros(40, header=header)
    rows.x, rows.y, rows.z = np.random.default_rng(1).uniform(0, 9, (3, 40))
    layout = lazrs.LazVlr.new_for_compression(6, 0, True)
    header.vlrs.append(laspy.VLR("laszip encoded", 22204, "", layout.record_data()))
    header.update(rows)
    header.are_points_compressed = True
    file = io.BytesIO()
    header.write_to(file)
    compressor = lazrs.LasZipCompressor(file, layout)
    compressor.reserve_offset_to_chunk_table()
    for start, stop in ((0, 1), (1, 26), (26, 40)):
        compressor.compress_many(np.frombuffer(rows.array[start:stop].tobytes(), np.uint8))
        compressor.finish_current_chunk()
    compressor.done()
    return file.getvalue()


def copc_file(path, form):
    """Return a COPC file of three levels, with extra bytes."""
    points = np.random.default_rng(form).uniform(0, 9, (60, 3))
    las_file(path.with_name("b.las"), form)
    header = las.read(path.with_name("b.las")).header
    with mock.patch.object(octree, "LEAF", 10), mock.patch.object(octree, "GRID", 2):
        WRITERS[".copc.laz"](path, Table(points, {"depth": np.arange(60.0)}, header))
    return path.read_bytes()


def changed_copc(random, content):
    """Change a number of a COPC file's octree, or of its table of chunks.

    Other changes rarely reach them.
    """
    content = bytearray(content)
    first, (place, size) = 429, struct.unpack_from("<2Q", content, 469)
    (points,) = struct.unpack_from("<I", content, 96)
    (chunks,) = struct.unpack_from("<q", content, points)
    low, high = [(first, first + 72), (place, place + size), (chunks, len(content))][
        random.integers(3)
    ]
    for _ in range(random.integers(1, 3)):
        width = int(random.choice([4, 8]))
        at = low + 4 * int(random.integers(max((high - low) // 4, 1)))
        number = NUMBERS[random.integers(len(NUMBERS))]
        if random.random() < 0.5:
            number = int.from_bytes(content[at : at + width], "little") + int(
                random.integers(-9, 9)
            )
        content[at : at + width] = (int(number) % 2 ** (8 * width)).to_bytes(width, "little")
    return bytes(content)
