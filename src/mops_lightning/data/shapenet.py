"""ShapeNetCore in PLY clouds, and ShapeNetPart in HDF5 or text files."""

import json
from collections.abc import Iterable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mops_lightning.data import ply_header
from mops_lightning.data.clouds import CloudDataset, Clouds, choose_classes
from mops_lightning.data.hdf5 import choose_and_fingerprint, read_clouds
from mops_lightning.errors import UserError, one_line
from mops_lightning.ops.points import normalize_unit_sphere
from mops_lightning.seeding import derive_seed

Cloud = NDArray[np.float32]
LISTED = {"train": ("train", "val"), "test": ("test",)}
"""Official lists in each split; the validation shapes are part of the training split."""


def shapenet_core(
    root: str | Path,
    n_points: int = 2048,
    classes: Sequence[str] | None = None,
    test_share: float = 0.15,
    normalize: bool = True,
    seed: int = 0,
) -> CloudDataset:
    """Read ``shape_net_core_uniform_samples_2048``: a folder of PLY clouds per synset.

    There is no official split; the test split is a random share of every class.

    Args:
        root: the folder with ``SYNSET/*.ply``; the synsets are the classes.
        n_points: number of points per cloud; the first ones are used.
        classes: synsets to keep, such as ``"02691156"`` for airplanes; None or empty means all.
        test_share: share of test clouds in a class, between 0 and 1; at least one cloud.
        normalize: whether to normalise clouds to the unit sphere.
        seed: seed of the split.

    Returns:
        Float32 clouds ``(S, n_points, 3)``.

    Raises:
        UserError: an argument or a file is invalid.
    """
    if not 0 < test_share < 1:
        raise UserError(f"test_share must be between 0 and 1, got {test_share}.")
    folder = _folder(root, n_points)
    found = {path.name: sorted(path.glob("*.ply")) for path in sorted(folder.iterdir())}
    found = {name: paths for name, paths in found.items() if paths}
    if not found:
        raise UserError(f"root: no SYNSET/*.ply in {folder}.")
    wanted = choose_classes(classes, list(found))
    rows: dict[str, list[tuple[Path, int]]] = {"train": [], "test": []}
    for label, name in enumerate(wanted):
        order = np.random.default_rng(derive_seed(seed, label)).permutation(len(found[name]))
        in_test = set(order[: max(round(len(order) * test_share), 1)].tolist())
        for number, path in enumerate(found[name]):
            rows["test" if number in in_test else "train"].append((path, label))
    splits = {}
    for split, listed in rows.items():
        clouds = ((_first(_ply(path), n_points, path), label) for path, label in listed)
        splits[split] = _stack(clouds, normalize)
    return choose_and_fingerprint("shapenet_core", splits, wanted, None, folder)


def shapenet_part(
    root: str | Path,
    n_points: int = 2048,
    classes: Sequence[str] | None = None,
    normalize: bool = True,
    seed: int = 0,
) -> CloudDataset:
    """Read ShapeNetPart with its official split, from HDF5 files or from text files.

    Args:
        root: the folder ``hdf5_data`` (``ply_data_{train,val,test}*.h5``,
            ``all_object_categories.txt``), or the folder of the text files
            (``synsetoffset2category.txt``, ``train_test_split/shuffled_*_file_list.json`` and
            ``SYNSET/*.txt`` with x, y, z in the first columns). The training split includes the
            validation clouds.
        n_points: number of points per cloud: the first ones in HDF5 files; random ones in text
            files, whose clouds differ in size, with repetitions in clouds with fewer points.
        classes: names to keep, such as ``Airplane``; None or empty means all 16.
        normalize: whether to normalise clouds to the unit sphere.
        seed: seed of the random points.

    Returns:
        Float32 clouds ``(S, n_points, 3)``.

    Raises:
        UserError: an argument or a file is invalid.
    """
    folder = _folder(root, n_points)
    if (folder / "all_object_categories.txt").is_file():
        known = list(_categories(folder / "all_object_categories.txt"))
        splits = {}
        for split, lists in LISTED.items():
            paths = [path for name in lists for path in sorted(folder.glob(f"ply_data_{name}*.h5"))]
            if not paths:
                raise UserError(f"root: no ply_data_{split}*.h5 in {folder}.")
            parts = [read_clouds(path, n_points, len(known)) for path in paths]
            points = torch.cat([part.points for part in parts])
            points = normalize_unit_sphere(points) if normalize else points
            splits[split] = Clouds(points, torch.cat([part.labels for part in parts]))
        return choose_and_fingerprint("shapenet_part_hdf5", splits, known, classes, folder)
    if not (folder / "synsetoffset2category.txt").is_file():
        raise UserError(
            f"root: no ShapeNetPart in {folder}. Looked for all_object_categories.txt (HDF5) and "
            "synsetoffset2category.txt (text)."
        )
    synsets = _categories(folder / "synsetoffset2category.txt")
    names = list(synsets)
    wanted = choose_classes(classes, names)
    labels = {synsets[name]: label for label, name in enumerate(wanted)}
    splits = {}
    for split, lists in LISTED.items():
        listed = [entry for name in lists for entry in _listing(folder, name)]
        chosen = [(synset, name) for synset, name in listed if synset in labels]
        clouds = (
            (_drawn(folder / synset / f"{name}.txt", n_points, seed, number), labels[synset])
            for number, (synset, name) in enumerate(chosen)
        )
        splits[split] = _stack(clouds, normalize)
    return choose_and_fingerprint("shapenet_part_text", splits, wanted, None, folder)


def _folder(root: str | Path, n_points: int) -> Path:
    if n_points < 1:
        raise UserError(f"n_points must be at least 1, got {n_points}.")
    folder = Path(root).expanduser()
    if not folder.is_dir():
        raise UserError(f"root: {folder} is not a folder.")
    return folder


def _stack(clouds: Iterable[tuple[Cloud, int]], normalize: bool) -> Clouds:
    points, labels = [], []
    for cloud, label in clouds:
        points.append(cloud)
        labels.append(label)
    stacked = torch.from_numpy(np.stack(points)) if points else torch.zeros(0, 1, 3)
    whole = normalize_unit_sphere(stacked) if normalize and points else stacked
    return Clouds(whole, torch.tensor(labels, dtype=torch.int64))


def _categories(path: Path) -> dict[str, str]:
    """Read synsets by name from lines with both."""
    rows = [line.split() for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    if not rows or any(len(row) != 2 for row in rows):
        raise UserError(f"{path} must have a name and a synset on every line.")
    return {row[0]: row[1] for row in rows}


def _listing(folder: Path, split: str) -> list[tuple[str, str]]:
    path = folder / "train_test_split" / f"shuffled_{split}_file_list.json"
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
        return [(entry.split("/")[-2], entry.split("/")[-1]) for entry in entries]
    except (OSError, ValueError, AttributeError, IndexError) as error:
        raise UserError(
            f"{path} must be a list of names such as shape_data/SYNSET/NAME: {error}."
        ) from None


def _ply(path: Path) -> Cloud:
    import trimesh

    try:
        data = BytesIO(ply_header.plain(path.read_bytes()))
        cloud: Any = trimesh.load(data, file_type="ply", process=False, skip_materials=True)
        points = np.asarray(cloud.vertices, np.float32)
    except Exception as error:  # trimesh raises many types of exception for damaged files
        raise UserError(f"{path} cannot be read as a PLY cloud: {one_line(error)}") from None
    return _finite(points, path)


def _drawn(path: Path, n_points: int, seed: int, number: int) -> Cloud:
    try:
        table = np.loadtxt(path, dtype=np.float32, ndmin=2)
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read as a table of numbers: {one_line(error)}") from None
    points = _finite(table[:, :3], path)
    rng = np.random.default_rng(derive_seed(seed, number))
    rows = rng.permutation(len(points))[:n_points]
    more = rng.integers(len(points), size=n_points - len(rows))
    return points[np.concatenate([rows, more])]


def _first(points: Cloud, n_points: int, path: Path) -> Cloud:
    if len(points) < n_points:
        raise UserError(
            f"n_points must be at most {len(points)}, the number of points in {path}, "
            f"got {n_points}."
        )
    return points[:n_points]


def _finite(points: Cloud, path: Path) -> Cloud:
    if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not np.isfinite(points).all():
        raise UserError(f"{path} must contain finite points x, y, z, got shape {points.shape}.")
    return points
