"""Clouds in HDF5 files: ``data`` (S, N, 3) and ``label`` (S,)."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np
import torch

from mops_lightning.data.clouds import CloudDataset, Clouds, choose_classes, select_classes
from mops_lightning.errors import UserError

NAMES = "shape_names.txt"


def hdf5(
    root: str | Path, n_points: int = 1024, classes: Sequence[str] | None = None
) -> CloudDataset:
    """Read a folder with ``train.h5`` and ``test.h5``.

    Args:
        root: the folder. ``shape_names.txt`` beside the files names the classes, one a line, in the
            order of their labels; without it they are called ``class_0`` and so on.
        n_points: the first so many points of each shape are taken.
        classes: names to keep; None or empty means all.

    Returns:
        Float32 clouds ``(S, n_points, 3)``, as they are stored.

    Raises:
        UserError: naming the setting or the file that is wrong.
    """
    if n_points < 1:
        raise UserError(f"dataset.n_points must be at least 1, got {n_points}.")
    folder = Path(root).expanduser()
    if not folder.is_dir():
        raise UserError(
            f"dataset.root: {folder} is not a folder. Give one with train.h5 and test.h5."
        )
    known = read_names(folder / NAMES) if (folder / NAMES).is_file() else None
    splits = {
        split: read_clouds(folder / f"{split}.h5", n_points, None if known is None else len(known))
        for split in ("train", "test")
    }
    if known is None:
        most = max(int(clouds.labels.max()) for clouds in splits.values() if len(clouds.labels))
        known = [f"class_{label}" for label in range(most + 1)]
    return choose_and_sign("hdf5", splits, known, classes, folder)


def choose_and_sign(
    kind: str,
    splits: dict[str, Clouds],
    known: Sequence[str],
    classes: Sequence[str] | None,
    folder: Path,
) -> CloudDataset:
    """Keep the chosen classes of both splits and take the fingerprint of what is left.

    Args:
        kind: the dataset's name, part of the fingerprint.
        splits: ``train`` and ``test``; labels are positions in ``known``.
        known: all classes.
        classes: ``dataset.classes``.
        folder: where they come from, for errors.

    Raises:
        UserError: a class is unknown or a split without shapes.
    """
    chosen = choose_classes(classes, known)
    n_points = splits["train"].points.shape[1]
    digest = hashlib.sha256(repr((kind, n_points, chosen)).encode())
    kept = []
    for split, whole in splits.items():
        clouds = select_classes(whole, known, chosen) if len(chosen) < len(known) else whole
        if not len(clouds.labels):
            raise UserError(
                f"dataset.classes: {', '.join(chosen)} has no {split} shape in {folder}."
            )
        digest.update(repr((split, tuple(clouds.points.shape))).encode())
        digest.update(clouds.points.numpy().data)
        digest.update(clouds.labels.numpy().data)
        kept.append(clouds)
    return CloudDataset(chosen, kept[0], kept[1], digest.hexdigest())


def read_names(path: Path) -> list[str]:
    """Read the names of the classes, one a line.

    Raises:
        UserError: the file cannot be read, or names a class twice or none.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"dataset.root: cannot read {path}: {error}.") from error
    names = [line.strip() for line in lines if line.strip()]
    if not names or len(set(names)) != len(names):
        raise UserError(f"{path} must list each class once, one a line.")
    return names


def read_clouds(path: Path, n_points: int, n_classes: int | None) -> Clouds:
    """Read the first points and the labels of one file, and check all that can be wrong.

    Args:
        path: an HDF5 file with ``data`` (S, N, 3) and ``label`` (S,) or (S, 1).
        n_points: how many points of each shape to read, at most N.
        n_classes: labels must lie below it; None allows any that are not negative.

    Raises:
        UserError: the file is missing, damaged or holds something else.
    """
    if not path.is_file():
        raise UserError(
            f"dataset.root: {path} is missing. Complete the folder, or give another with "
            "dataset.root=PATH."
        )
    try:
        with h5py.File(path, "r") as file:
            for key in ("data", "label"):
                if not isinstance(file.get(key), h5py.Dataset):
                    raise UserError(f"{path} has no dataset {key!r}; it holds {sorted(file)}.")
            data, label = file["data"], file["label"]
            shapes, kinds = (data.shape, label.shape), data.dtype.kind + label.dtype.kind
            if (
                data.ndim != 3
                or data.shape[2] != 3
                or label.shape not in ((len(data),), (len(data), 1))
                or kinds not in ("fu", "fi")
            ):
                raise UserError(
                    f"{path} must hold data (S, N, 3) of floats and label (S, 1) or (S,) of "
                    f"integers, got {shapes[0]} {data.dtype} and {shapes[1]} {label.dtype}."
                )
            if data.shape[1] < n_points:
                raise UserError(
                    f"dataset.n_points is {n_points}, but {path} stores {data.shape[1]} points "
                    f"a shape. Set dataset.n_points={data.shape[1]} or less."
                )
            with np.errstate(over="ignore"):  # what overflows is found below
                points = np.asarray(data[:, :n_points], dtype=np.float32)
            labels = np.asarray(label[()], dtype=np.int64).reshape(-1)
    except (OSError, RuntimeError, KeyError) as error:
        raise UserError(
            f"{path} is not a whole HDF5 file ({error}). Replace it by a whole one."
        ) from error
    if not np.isfinite(points).all():
        raise UserError(f"{path} holds NaN or infinite coordinates. Replace it by a whole one.")
    least, most = (labels.min(), labels.max()) if len(labels) else (0, 0)
    if least < 0 or (n_classes is not None and most >= n_classes):
        named = "" if n_classes is None else f" names {n_classes} classes (0 to {n_classes - 1})"
        raise UserError(
            f"{path} holds labels from {least} to {most}, but shape_names.txt"
            f"{named or ' can name none below 0'}."
        )
    return Clouds(torch.from_numpy(points), torch.from_numpy(labels))
