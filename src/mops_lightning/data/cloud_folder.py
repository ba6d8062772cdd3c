"""Datasets of a user's own clouds: a folder of files of any format that ``downsample`` reads."""

import sys
import zlib
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from mops_lightning.data.clouds import CloudDataset, Clouds, choose_classes
from mops_lightning.data.crops import Crop, check_crop, random_crops
from mops_lightning.data.file_splits import Box, class_of, split_by_folder, split_by_share
from mops_lightning.data.formats.registry import READABLE, read
from mops_lightning.data.hdf5 import choose_and_fingerprint
from mops_lightning.data.mesh_sampling import mesh_root
from mops_lightning.data.split_list import SPLITS, read_split_list
from mops_lightning.errors import UserError
from mops_lightning.ops.points import normalize_unit_sphere
from mops_lightning.seeding import derive_seed


class Source(NamedTuple):
    """What is kept of a file: its path, its bounding box and its crops ``(K, n_points, 3)``."""

    name: PurePosixPath
    box: Box
    crops: NDArray[np.float32]


def cloud_folder(
    root: str | Path,
    n_points: int = 1024,
    classes: Sequence[str] | None = None,
    split_file: str | Path | None = None,
    test_share: float = 0.2,
    crop: Crop = "nearest",
    crop_size: float | None = None,
    crops: int = 32,
    surface: int | None = None,
    skip_broken: bool = False,
    seed: int = 0,
) -> CloudDataset:
    """Draw crops of the clouds in a folder and its subfolders, one cloud per file.

    A file is in one split only. The split comes from ``split_file``; else from folders named
    ``train`` and ``test``; else a random share of the files is the test split. Of files that are
    neighbouring tiles of one scene, the training tiles that touch a test tile are left out.

    Args:
        root: the folder. The first folder of a path is the class, if there is one.
        n_points: number of points per crop.
        classes: names to keep; None or empty means all.
        split_file: lines ``PATH,train`` and ``PATH,test``, as for ``meshes``; files that are not
            listed are ignored.
        test_share: share of test files in a class, between 0 and 1.
        crop: ``nearest`` takes the points nearest to a drawn point, as the tiles of ``downsample
            --tile``; ``cube`` random points of a cube of side ``crop_size``, as ``--tile-size``;
            ``whole`` random points of the cloud.
        crop_size: side of the cube, in the files' own unit.
        crops: number of crops per file.
        surface: points to sample from a mesh's surface first; None: 10,000 or 8 ``n_points``.
        skip_broken: whether to skip files without a usable cloud instead of raising an error.
        seed: seed of the split and the crops.

    Returns:
        Float32 clouds ``(S, n_points, 3)`` in the unit sphere, with the centroid at the origin.
        ``notes`` has the number of files per split, of skipped files and of tiles left out.

    Raises:
        UserError: an argument or a file is invalid, or a split is empty.
    """
    minima = {"n_points": (n_points, 2), "crops": (crops, 1), "seed": (seed, 0)}
    folder = mesh_root(root, minima)
    _check(test_share, crop, crop_size, surface)
    listed = None
    if split_file:
        listed = dict(read_split_list(folder, Path(split_file).expanduser(), READABLE, False))
    names = sorted(listed) if listed else cloud_files(folder)
    chosen = choose_classes(classes, sorted(set(map(class_of, names))))
    names = [name for name in names if class_of(name) in chosen]
    by_folder = split_by_folder(names) if listed is None else None
    sources: list[Source] = []
    console = Console(stderr=True)
    for name in track(names, "Reading clouds", console=console, disable=not console.is_terminal):
        rng = np.random.default_rng(derive_seed(seed, zlib.crc32(str(name).encode())))
        try:
            table = read(folder / name, surface or max(10_000, 8 * n_points), seed).finite()
            drawn = random_crops(table.points, n_points, crops, crop, crop_size, rng, folder / name)
        except UserError as error:
            if not skip_broken:
                raise UserError(
                    f"{error} To leave out files without a usable cloud: dataset.skip_broken=true."
                ) from error
            continue
        box = np.stack([table.points.min(0), table.points.max(0)])
        sources.append(Source(name, box, drawn))
    if listed is not None:
        splits = [listed[source.name] for source in sources]
    elif by_folder is not None:
        split_of = dict(zip(names, by_folder, strict=True))
        splits = [split_of[source.name] for source in sources]
    else:
        kept = [source.name for source in sources]
        splits = split_by_share(kept, [source.box for source in sources], test_share, seed)
    return _dataset(folder, sources, splits, chosen, len(names) - len(sources))


def _check(test_share: float, crop: str, crop_size: float | None, surface: int | None) -> None:
    if not 0 < test_share < 1:
        raise UserError(f"test_share must be between 0 and 1, got {test_share}.")
    check_crop(crop, crop_size)
    if surface is not None and surface < 1:
        raise UserError(f"surface must be at least 1, got {surface}.")


def cloud_files(folder: Path, pattern: str = "*") -> list[PurePosixPath]:
    """Return the relative paths of the clouds and meshes in a folder and its subfolders, sorted.

    Args:
        folder: the folder.
        pattern: of the ends of the paths, as in ``velodyne/*.bin``.

    Raises:
        UserError: there is none.
    """
    names = sorted(
        PurePosixPath(path.relative_to(folder).as_posix())
        for path in folder.rglob(pattern)
        if path.suffix.lower() in READABLE and path.is_file()
    )
    names = [name for name in names if not any(part.startswith(".") for part in name.parts)]
    if not names:
        raise UserError(
            f"root: no cloud in {folder} or its subfolders. Looked for {pattern} ending in "
            f"{', '.join(READABLE)}."
        )
    return names


def _dataset(
    folder: Path, sources: list[Source], splits: list[str], classes: tuple[str, ...], skipped: int
) -> CloudDataset:
    """Collect the crops of both splits; files with an empty split are left out."""
    counts = {split: splits.count(split) for split in SPLITS}
    notes: dict[str, Any] = {f"{split}_files": number for split, number in counts.items()}
    notes |= {"skipped_files": skipped, "left_out_tiles": splits.count("")}
    if skipped or splits.count(""):
        print(
            f"{folder}: {skipped} files without a usable cloud skipped, {splits.count('')} training"
            " tiles left out because they touch a test tile.",
            file=sys.stderr,
        )
    clouds: dict[str, Clouds] = {}
    for split in SPLITS:
        rows = [i for i, one in enumerate(splits) if one == split]
        if not rows:
            raise UserError(f"root: {folder} has no {split} file ({skipped} files skipped).")
        crops = torch.from_numpy(np.concatenate([sources[i].crops for i in rows]))
        each = len(sources[0].crops)
        labels = torch.tensor([classes.index(class_of(sources[i].name)) for i in rows])
        clouds[split] = Clouds(
            normalize_unit_sphere(crops),
            labels.repeat_interleave(each),
            torch.tensor(rows).repeat_interleave(each),
        )
    found = choose_and_fingerprint("clouds", clouds, classes, None, folder)
    return CloudDataset(found.class_names, found.train, found.test, found.fingerprint, notes)
