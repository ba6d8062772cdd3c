"""Dask schedulers in tests."""

import os
from contextlib import contextmanager


@contextmanager
def environment_kept():
    """Restore the environment: Dask sets OMP_NUM_THREADS=1 for its workers in this process too."""
    before = dict(os.environ)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)
