"""Folders of every form of data that sweeps and results pages name, with a few small clouds."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.registry import WRITERS
from mops_lightning.data.formats.table import Table
from tests.support.hdf5 import write_file
from tests.support.meshes import BALL, BOX, scaled, write_mesh

POINTS = 1024
"""Points of a cloud in ModelNet40's files."""

SPLITS = ("train", "test")


def write_all(top: Path) -> None:
    """Write a folder for each form of data.

    They are modelnet40, hdf5, meshes, mesh_sequence, clouds and airborne.
    """
    _write_modelnet40(top / "modelnet40")
    _write_one_class(top / "hdf5")
    _write_meshes(top / "meshes")
    for number in range(12):
        path = top / "mesh_sequence" / "walk" / f"{number:02d}.ply"
        scale = 1 + number / 9
        write_mesh(path, scaled(BOX, scale))
    _write_clouds(top / "clouds")
    write_airborne(top / "airborne" / "train" / "tile.las", 0)
    write_airborne(top / "airborne" / "test" / "tile.las", 1)


def _write_meshes(folder: Path) -> None:
    """Write two balls and two boxes of different size for each split."""
    for split in SPLITS:
        for number in (1, 2):
            scale = float(number)
            write_mesh(folder / "ball" / split / f"{number}.off", scaled(BALL, scale))
            write_mesh(folder / "box" / split / f"{number}.off", scaled(BOX, scale))


def _write_clouds(folder: Path) -> None:
    """Write six clouds of random points."""
    folder.mkdir()
    for number in range(6):
        random = np.random.default_rng(number)
        cloud = random.random((3000, 3)).astype("float32")
        np.save(folder / f"scan{number}.npy", cloud)


def write_airborne(path: Path, seed: int, number: int = 1000) -> None:
    """Write an airborne scan: ground (class 2), and bright points of one return above it (1)."""
    random = np.random.default_rng(seed)
    points = random.uniform(0, [40, 30, 0.2], (number, 3))
    points += (500_000, 4_000_000, 100)
    is_ground = random.random(number) < 0.6
    is_above = ~is_ground
    heights = random.uniform(2, 6, is_above.sum())
    points[is_above, 2] += heights
    two_or_one = np.where(is_ground, 2, 1)
    intensity = np.where(is_ground, 40, 200)
    columns = {
        "classification": two_or_one.astype("uint8"),
        "intensity": intensity.astype("uint16"),
        "return_number": two_or_one.astype("uint8"),
        "number_of_returns": np.full(number, 2, "uint8"),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    WRITERS[".las"](path, Table(points, columns))


def _write_modelnet40(folder: Path) -> None:
    """Write ModelNet40's files with clouds for two of its 40 classes."""
    folder.mkdir()
    names = "airplane\n"
    for number in range(1, 40):
        names += f"class_{number}\n"
    (folder / "shape_names.txt").write_text(names)
    _write_modelnet40_split(folder, "train", seed=0, number=8)
    _write_modelnet40_split(folder, "test", seed=1, number=4)


def _write_modelnet40_split(folder: Path, split: str, seed: int, number: int) -> None:
    points = normal_clouds(seed, number).astype("float32")
    norms = np.linalg.norm(points, axis=2)
    radii = norms.max(axis=1)
    points /= radii[:, None, None]
    labels = np.arange(number)[:, None] % 2
    name = f"ply_data_{split}0.h5"
    write_file(folder / name, data=points, label=labels.astype("uint8"))
    (folder / f"{split}_files.txt").write_text(f"data/{folder.name}/{name}\n")


def normal_clouds(seed: int, number: int) -> NDArray[np.float64]:
    """Return clouds ``(number, POINTS, 3)`` of normally distributed points."""
    random = np.random.default_rng(seed)
    return random.normal(size=(number, POINTS, 3))


def _write_one_class(folder: Path) -> None:
    """Write train.h5 and test.h5 of one class without names, as the paper's airplanes are."""
    folder.mkdir()
    for split, number in (("train", 8), ("test", 4)):
        points = normal_clouds(number, number)
        labels = np.zeros(number, "int64")
        write_file(folder / f"{split}.h5", data=points.astype("float32"), label=labels)
