"""What reads the fuzzed files, in a process with limits in time and memory."""

import importlib
import traceback
from pathlib import Path

from mops_lightning import filesystem
from mops_lightning.data.formats import guard
from mops_lightning.errors import UserError

SECONDS, MEMORY = 60.0, 1 << 30
MODULES = {
    "hdf5": "mops_lightning.data.hdf5", "names": "mops_lightning.data.hdf5",
    "weights": "mops_lightning.zoo.load",
    "checkpoint": "mops_lightning.training.checkpoint",
    "record": "mops_lightning.records.run_record", "pictured": "mops_lightning.viz.snapshots",
}  # fmt: skip
"""Imported before the limits apply."""


def outcome(kind, path):
    """Read a file: ``read``, ``refused``, or the traceback of what must not happen."""
    guard.SECONDS, filesystem.MEMORY = SECONDS, MEMORY
    importlib.import_module(MODULES.get(kind.split()[0], "mops_lightning.data.formats.registry"))
    try:
        with guard.limited(path):
            READERS.get(kind.split()[0], read_cloud)(path)
    except UserError as error:
        said = str(error)
        if len(said) > 3000 or "\n" in said:
            return f"not one line: {said}"
        return "memory" if "memory" in said or "MemoryError" in said else "refused"
    except Exception:
        return traceback.format_exc()
    return "read"


def read_cloud(path):
    from mops_lightning.data.formats.registry import CHUNKED, open_cloud_file, read

    if path.suffix in CHUNKED:
        try:
            cloud = open_cloud_file(path)
            for rows in cloud.row_ranges(max(cloud.number // 3, 1))[:4]:
                cloud.read(rows)
        except UserError:
            pass
    read(path, 50, 0)


def read_hdf5(path):
    from mops_lightning.data.hdf5 import read_clouds

    read_clouds(path, 20, None)


def read_names(path):
    from mops_lightning.data.hdf5 import read_names

    read_names(path)


def read_weights(path):
    from mops_lightning.zoo.load import load

    load(path)


def read_checkpoint(path):
    from mops_lightning.training.checkpoint import Checkpoint

    Checkpoint.read(path)


def read_record(path):
    from mops_lightning.records import run_record

    path.replace(path.with_name(run_record.FILE))
    run_record.read(path.parent)


def read_pictured(path):
    from mops_lightning.viz.snapshots import load_clouds

    load_clouds(path)


READERS = {
    "hdf5": read_hdf5, "names": read_names,
    "weights": read_weights, "checkpoint": read_checkpoint,
    "record": read_record, "pictured": read_pictured,
}  # fmt: skip


def try_file(kind, path, content):
    """Write a fuzzed file and read it; in a process of ``Processes``."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return outcome(kind, path)
