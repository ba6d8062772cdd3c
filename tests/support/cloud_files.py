"""Cloud files that tests write and read."""

from mops_lightning.data.formats.registry import WRITERS, read, suffix_of
from mops_lightning.data.formats.table import Table


def write_table(path, table):
    """Write a table in the format of the file's name."""
    writer = WRITERS[suffix_of(path)]
    writer(path, table)


def write_cloud(path, points, columns=None):
    """Write points ``(N, 3)`` and named columns ``(N,)`` in the format of the file's name."""
    table = Table(points, columns or {})
    write_table(path, table)


def contents(path):
    """Return the whole table of a file; a mesh is sampled at 9 points."""
    return read(path, 9, 0)
