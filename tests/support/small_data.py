"""Folders of every form of data that sweeps and results pages name, with a few small clouds."""

from pathlib import Path

import numpy as np

from mops_lightning.data.formats.registry import WRITERS
from mops_lightning.data.formats.table import Table
from tests.support.hdf5 import write_file
from tests.support.meshes import BALL, BOX, scaled, write_mesh

POINTS = 1024


def write_all(top: Path) -> None:
    """Write a folder for each form of data.

    They are modelnet40, hdf5, meshes, mesh_sequence, clouds and airborne.
    """
    _write_modelnet40(top / "modelnet40")
    _write_one_class(top / "hdf5")
    for split in ("train", "test"):
        for name, mesh in (("ball", BALL), ("box", BOX)):
            for number in (1, 2):
                path = top / "meshes" / name / split / f"{number}.off"
                write_mesh(path, scaled(mesh, float(number)))
    for number in range(12):
        path = top / "mesh_sequence" / "walk" / f"{number:02d}.ply"
        write_mesh(path, scaled(BOX, 1 + number / 9))
    (top / "clouds").mkdir()
    for number in range(6):
        cloud = np.random.default_rng(number).random((3000, 3)).astype("float32")
        np.save(top / "clouds" / f"scan{number}.npy", cloud)
    for split, seed in (("train", 0), ("test", 1)):
        write_airborne(top / "airborne" / split / "tile.las", seed)


def write_airborne(path: Path, seed: int, number: int = 1000) -> None:
    """Write an airborne scan: ground (class 2), and bright points of one return above it (1)."""
    random = np.random.default_rng(seed)
    points = random.uniform(0, [40, 30, 0.2], (number, 3))
    points += (500_000, 4_000_000, 100)
    is_ground = random.random(number) < 0.6
    points[~is_ground, 2] += random.uniform(2, 6, (~is_ground).sum())
    columns = {
        "classification": np.where(is_ground, 2, 1).astype("uint8"),
        "intensity": np.where(is_ground, 40, 200).astype("uint16"),
        "return_number": np.where(is_ground, 2, 1).astype("uint8"),
        "number_of_returns": np.full(number, 2, "uint8"),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    WRITERS[".las"](path, Table(points, columns))


def _write_modelnet40(folder: Path) -> None:
    """Write ModelNet40's files with clouds for two of its 40 classes."""
    folder.mkdir()
    names = [f"class_{number}" for number in range(40)]
    names[0] = "airplane"
    (folder / "shape_names.txt").write_text("\n".join(names) + "\n")
    for seed, (split, clouds) in enumerate((("train", 8), ("test", 4))):
        points = np.random.default_rng(seed).normal(size=(clouds, POINTS, 3)).astype("float32")
        points /= np.linalg.norm(points, axis=2).max(axis=1)[:, None, None]
        labels = np.arange(clouds)[:, None] % 2
        write_file(folder / f"ply_data_{split}0.h5", data=points, label=labels.astype("uint8"))
        (folder / f"{split}_files.txt").write_text(f"data/{folder.name}/ply_data_{split}0.h5\n")


def _write_one_class(folder: Path) -> None:
    """Write train.h5 and test.h5 of one class without names, as the paper's airplanes are."""
    folder.mkdir()
    for split, clouds in (("train", 8), ("test", 4)):
        points = np.random.default_rng(clouds).normal(size=(clouds, POINTS, 3)).astype("float32")
        write_file(folder / f"{split}.h5", data=points, label=np.zeros(clouds, "int64"))
