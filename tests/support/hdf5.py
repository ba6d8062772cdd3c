"""Small HDF5 files."""

from pathlib import Path
from typing import Any

import h5py


def write_file(path: Path, **datasets: Any) -> None:
    with h5py.File(path, "w") as file:
        for key, value in datasets.items():
            file.create_dataset(key, data=value)
