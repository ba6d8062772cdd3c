"""Split the training shapes of ModelNet40 into shapes to train on and held-out shapes.

    python benchmarks/held_out.py MODELNET40 FOLDER [--training-shapes N]

FOLDER becomes a ModelNet40 folder whose test shapes are a fifth of the training shapes, drawn with
a fixed seed; with N, only so many of the others are training shapes. The trials of
results/PROTOCOL.md read it; they read no test shape.
"""

import argparse
import shutil
from pathlib import Path

import h5py
import numpy as np
import torch

from mops_lightning.data.hdf5 import read_lines

HELD_OUT_SHARE = 0.2
SEED = 0


def split_indices(shapes: int, training: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of the shapes to train on and of the held-out shapes, each in order.

    Args:
        shapes: number of shapes.
        training: how many of the shapes that are not held out to train on; all by default.
    """
    order = torch.randperm(shapes, generator=torch.Generator().manual_seed(SEED)).numpy()
    held_out = round(shapes * HELD_OUT_SHARE)
    rest = order[held_out:]
    return np.sort(rest[:training]), np.sort(order[:held_out])


def write(folder: Path, split: str, points: np.ndarray, labels: np.ndarray) -> None:
    """Write one split as the file ``ply_data_SPLIT0.h5`` and the list that names it."""
    name = f"ply_data_{split}0.h5"
    with h5py.File(folder / name, "w") as file:
        file["data"] = points
        file["label"] = labels
    (folder / f"{split}_files.txt").write_text(f"{name}\n", encoding="utf-8")


def main() -> None:
    """Read the training files of one folder and write the other folder."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("modelnet40", type=Path, help="folder with train_files.txt")
    parser.add_argument("folder", type=Path, help="folder to write")
    parser.add_argument("--training-shapes", type=int, help="number of them; default: all")
    arguments = parser.parse_args()

    points = []
    labels = []
    for line in read_lines(arguments.modelnet40 / "train_files.txt"):
        with h5py.File(arguments.modelnet40 / Path(line).name) as file:
            points.append(file["data"][:])
            labels.append(file["label"][:])
    all_points = np.concatenate(points)
    all_labels = np.concatenate(labels)

    training, held_out = split_indices(len(all_points), arguments.training_shapes)
    arguments.folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(arguments.modelnet40 / "shape_names.txt", arguments.folder)
    write(arguments.folder, "train", all_points[training], all_labels[training])
    write(arguments.folder, "test", all_points[held_out], all_labels[held_out])
    print(f"{len(training)} training shapes, {len(held_out)} held-out shapes: {arguments.folder}")


if __name__ == "__main__":
    main()
