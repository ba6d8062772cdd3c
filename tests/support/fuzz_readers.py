"""What reads the fuzzed files, in a process with limits in time and memory."""

import traceback
from pkgutil import resolve_name

from mops_lightning.errors import UserError

READERS: dict[str, tuple] = {
    "hdf5": ("mops_lightning.data.hdf5:read_clouds", 20, None),
    "names": ("mops_lightning.data.hdf5:read_names",),
    "weights": ("mops_lightning.zoo.load:load",),
    "checkpoint": ("mops_lightning.training.checkpoint:Checkpoint.read",),
    "label": ("tests.support.fuzz_readers:read_labelled_scan",),
    "record": ("tests.support.fuzz_readers:read_record",),
    "pictured": ("mops_lightning.viz.figures:load_clouds",),
}
"""Functions that read a kind of file, with the arguments after its path; others are clouds."""


def outcome(path, kind):
    """Read a file: ``read``, ``refused``, or the traceback of what must not happen."""
    cloud = ("tests.support.fuzz_readers:read_cloud",)
    reader, *arguments = READERS.get(kind.split()[0], cloud)
    read = resolve_name(reader)
    try:
        read(path, *arguments)
    except UserError as error:
        said = str(error)
        return "refused" if len(said) < 3000 and "\n" not in said else f"not one line: {said}"
    except Exception:
        return traceback.format_exc()
    return "read"


def read_cloud(path):
    from mops_lightning.data.formats.area import Area
    from mops_lightning.data.formats.registry import CHUNKED, open_cloud_file, read

    areas = (None, Area(level=1)) if path.name.endswith(".copc.laz") else (None,)
    for area in areas:
        if path.suffix not in CHUNKED:
            continue
        try:
            cloud = open_cloud_file(path, area)
            for rows in cloud.row_ranges(max(cloud.number // 3, 1))[:4]:
                cloud.read(rows)
        except UserError:
            pass
    read(path, 50, 0)


def read_labelled_scan(path):
    import numpy as np

    scan = path.with_suffix(".bin")
    np.ones((40, 4), "<f4").tofile(scan)
    read_cloud(scan)


def read_record(path):
    from mops_lightning.records import run_record

    path.replace(path.with_name(run_record.FILE))
    run_record.read(path.parent)
