"""Clouds in HDF5 files: ``data`` (S, N, 3) and ``label`` (S,)."""

from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np
import torch

from mops_lightning.data.clouds import CloudDataset, Clouds, make_dataset
from mops_lightning.data.formats.guard import reading
from mops_lightning.errors import UserError, check_at_least
from mops_lightning.filesystem import memory

NAMES = "shape_names.txt"
MAX_CLASSES = 10_000
"""Most classes without a list of their names."""


def hdf5(
    root: str | Path, n_points: int = 1024, classes: Sequence[str] | None = None
) -> CloudDataset:
    """Read a folder with ``train.h5`` and ``test.h5``.

    Args:
        root: the folder. An optional ``shape_names.txt`` lists the classes, one per line, in the
            order of their labels; the default names are ``class_0``, ``class_1`` and so on.
        n_points: number of points per shape; the first ones are used.
        classes: names to keep; None or empty means all.

    Returns:
        Float32 clouds ``(S, n_points, 3)``, without normalisation.

    Raises:
        UserError: an argument or a file is invalid.
    """
    folder = Path(root).expanduser()
    file_of_names = folder / NAMES
    known = None
    n_classes = None
    if file_of_names.is_file():
        known = read_names(file_of_names)
        n_classes = len(known)
    splits = {
        "train": read_clouds(folder / "train.h5", n_points, n_classes),
        "test": read_clouds(folder / "test.h5", n_points, n_classes),
    }
    if known is None:
        highest = max(int(clouds.labels.max()) for clouds in splits.values())
        known = [f"class_{label}" for label in range(highest + 1)]
    return make_dataset("hdf5", splits, known, classes, folder)


def read_names(path: Path) -> list[str]:
    """Read the names of the classes, one per line.

    Raises:
        UserError: the file cannot be read, is empty or lists a class twice.
    """
    names = read_lines(path)
    is_each_once = len(set(names)) == len(names)
    if not names or not is_each_once:
        raise UserError(f"{path} must list each class once, one per line.")
    return names


def read_lines(path: Path) -> list[str]:
    """Read the lines of a file, without empty ones.

    Raises:
        UserError: the file cannot be read.
    """
    with reading(path):
        lines = path.read_text(encoding="utf-8").splitlines()
    return [line.strip() for line in lines if line.strip()]


def read_clouds(path: Path, n_points: int, n_classes: int | None) -> Clouds:
    """Read and check the first points and the labels of a file.

    Args:
        path: an HDF5 file with ``data`` (S, N, 3) and ``label`` (S,) or (S, 1).
        n_points: number of points per shape to read, at most N.
        n_classes: number of classes; None allows labels below ``MAX_CLASSES``.

    Raises:
        UserError: the file is missing, damaged or has other content.
    """
    check_at_least(1, n_points=n_points)
    if not path.is_file():
        raise UserError(f"root: {path} is missing. Complete the folder, or use another root.")
    with reading(path), h5py.File(path, "r") as file:
        data = _dataset(path, file, "data")
        label = _dataset(path, file, "label")
        if not _are_clouds(data, label):
            raise UserError(
                f"{path} must contain data (S, N, 3) of floats and label (S, 1) or (S,) of "
                f"integers, got {data.shape} {data.dtype} and {label.shape} {label.dtype}."
            )
        number, size, _ = data.shape
        if size < n_points:
            raise UserError(
                f"n_points must be at most {size}, the points per shape in {path}, got {n_points}."
            )
        if number == 0:
            raise UserError(f"{path} contains no shapes.")
        wanted_bytes = number * n_points * 3 * data.dtype.itemsize
        if wanted_bytes > memory(path):
            raise UserError(
                f"{path} announces {number:,} shapes, much more than its "
                f"{path.stat().st_size:,} bytes hold. Replace it by an intact copy."
            )
        with np.errstate(over="ignore"):  # overflows are detected below
            first_points = data[:, :n_points]
            points = np.asarray(first_points, dtype=np.float32)
        labels = np.asarray(label[()], dtype=np.int64).reshape(-1)
    if not np.isfinite(points).all():
        raise UserError(f"{path} contains NaN or infinite values. Replace it by an intact copy.")
    low = labels.min()
    high = labels.max()
    allowed = n_classes
    reason = f"as {NAMES} lists {n_classes} classes"
    if allowed is None:
        allowed = MAX_CLASSES
        reason = f"without {NAMES}"
    if low < 0 or high >= allowed:
        raise UserError(
            f"{path} must have labels from 0 to {allowed - 1}, {reason}, got {low} to {high}."
        )
    return Clouds(torch.from_numpy(points), torch.from_numpy(labels))


def _are_clouds(data: h5py.Dataset, label: h5py.Dataset) -> bool:
    if data.ndim != 3 or data.shape[2] != 3:
        return False
    number = data.shape[0]
    is_one_each = label.shape in ((number,), (number, 1))
    return is_one_each and data.dtype.kind == "f" and label.dtype.kind in "ui"


def _dataset(path: Path, file: h5py.File, key: str) -> h5py.Dataset:
    """Return a dataset whose numbers are in the file itself, not in another one."""
    found = None
    refers_elsewhere = False
    if key in file:
        link = file.get(key, getlink=True)
        refers_elsewhere = not isinstance(link, h5py.HardLink)
    if not refers_elsewhere:
        found = file.get(key)
    if isinstance(found, h5py.Dataset) and (found.is_virtual or found.external):
        refers_elsewhere = True
    if refers_elsewhere:
        raise UserError(f"{path}: dataset {key!r} refers to other files, which is not accepted.")
    if not isinstance(found, h5py.Dataset):
        names = sorted(file)[:20]
        raise UserError(f"{path} has no dataset {key!r}; it contains {names}.")
    return found
