"""What reads the fuzzed files, in a process with limits in time and memory."""

import traceback

from mops_lightning.errors import UserError


def outcome(path, kind):
    """Read a file: ``read``, ``refused``, or the traceback of what must not happen."""
    try:
        READERS.get(kind.split()[0], read_cloud)(path)
    except UserError as error:
        said = str(error)
        return "refused" if len(said) < 3000 and "\n" not in said else f"not one line: {said}"
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
    from mops_lightning.viz.figures import load_clouds

    load_clouds(path)


READERS = {
    "hdf5": read_hdf5, "names": read_names,
    "weights": read_weights, "checkpoint": read_checkpoint,
    "record": read_record, "pictured": read_pictured,
}  # fmt: skip
