"""Datasets of scan pairs with known motions: a folder of scans and a text file of motions."""

import math
import sys
import zlib
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from mops_lightning.data.clouds import CloudDataset, Clouds
from mops_lightning.data.crops import Crop, check_crop
from mops_lightning.data.formats.registry import read
from mops_lightning.data.hdf5 import choose_and_fingerprint
from mops_lightning.data.mesh_sampling import mesh_root
from mops_lightning.data.motions import PoseRules, ScanPair
from mops_lightning.data.pair_crops import CropRules, PairCrops, Scan, crop_pair
from mops_lightning.data.scan_scenes import Listed, list_scans, split_scans
from mops_lightning.data.split_list import SPLITS
from mops_lightning.errors import UserError
from mops_lightning.ops.rigid import quaternion_from_matrix, rotation_angle
from mops_lightning.seeding import derive_seed
from mops_lightning.types import TruePairs

KEPT_SCANS = 16
"""Scans in memory while pairs are read; pairs of poses up to this gap read each scan once."""


def scan_pairs(
    root: str | Path,
    motions: str | Path,
    scans: str | None = None,
    calib: str | Path | None = None,
    gap: int | None = None,
    distance: float | None = None,
    n_points: int = 1024,
    test_share: float = 0.2,
    crop: Crop = "whole",
    crop_size: float | None = None,
    crops: int = 8,
    overlap_distance: float | None = None,
    min_overlap: float = 0.0,
    seed: int = 0,
) -> CloudDataset:
    """Draw pairs of crops from pairs of scans with known motions.

    A scan is in one split only: pairs with one scan in each split are left out. The split comes
    from folders named ``train`` and ``test``; else the last scans, in the order of scenes and
    names, are the test split.

    Args:
        root: the folder of the scans. If ``motions`` is in its subfolders, each of these is a
            scene with scans and motions of its own.
        motions: file of poses or of pairs, see ``motions.read_motions``; relative to the working
            directory, to ``root`` or to the scenes.
        scans: pattern of the scans' paths, such as ``velodyne/*.bin``; None: all files that can be
            read, except ``motions`` and ``calib``. Scans are numbered from 0 in the order of their
            names, in which scan_9 is before scan_10.
        calib: file with KITTI's calibration ``Tr``; found as ``motions``.
        gap: pairs of poses are this many scans apart; None: 1, unless ``distance`` is given.
        distance: pairs of poses are those at most this far apart.
        n_points: number of points per crop.
        test_share: share of test pairs, between 0 and 1.
        crop: ``whole`` takes random points of both scans; ``nearest`` the points nearest to a
            place that both scans contain; ``cube`` random points of cubes around it, parallel to
            the axes of each scan.
        crop_size: side of the cube, in the scans' own unit.
        crops: number of crops per pair.
        overlap_distance: a point overlaps a scan that has a point within this distance; None: 3 %
            of the median distance of the source's points from their centroid.
        min_overlap: pairs with a smaller share of overlapping points are left out. With 0, a pair
            without overlap is an error.
        seed: seed of the crops.

    Returns:
        Sources in ``points`` and targets in ``pairs``, see ``TruePairs``; classes are scenes.
        Translation errors are measured at the origin of the source's coordinates with
        ``crop=whole``, else at the centre of the crop. ``notes`` has numbers, overlaps and motions.

    Raises:
        UserError: an argument or a file is invalid, scans do not overlap, or a split is empty.
    """
    minima = {"n_points": (n_points, 2), "crops": (crops, 1), "seed": (seed, 0)}
    folder = mesh_root(root, minima)
    check_crop(crop, crop_size)
    _check(test_share, overlap_distance, min_overlap)
    poses = PoseRules(Path(calib).expanduser() if calib else None, gap, distance)
    listed = list_scans(folder, Path(motions).expanduser(), scans, poses)
    splits = split_scans(listed, test_share)
    kept = [pair for pair in listed.pairs if splits[pair.source] == splits[pair.target]]
    rules = CropRules(n_points, crops, crop, crop_size, overlap_distance, min_overlap)
    drawn = _crops(folder, listed.scans, kept, rules, seed)
    return _dataset(folder, listed, splits, drawn)


def _check(test_share: float, overlap_distance: float | None, min_overlap: float) -> None:
    if not 0 < test_share < 1:
        raise UserError(f"test_share must be between 0 and 1, got {test_share}.")
    if overlap_distance is not None and not 0 < overlap_distance < math.inf:
        raise UserError(f"overlap_distance must be above 0 and finite, got {overlap_distance}.")
    if not 0 <= min_overlap < 1:
        raise UserError(f"min_overlap must be at least 0 and below 1, got {min_overlap}.")


def _crops(
    folder: Path, names: list[PurePosixPath], pairs: list[ScanPair], rules: CropRules, seed: int
) -> list[tuple[ScanPair, PairCrops]]:
    """Read the scans and draw the crops of all pairs that overlap enough."""

    @lru_cache(KEPT_SCANS)
    def scan(position: int) -> Scan:
        path = folder / names[position]
        own = derive_seed(seed, zlib.crc32(str(names[position]).encode()))
        points = read(path, max(10_000, 8 * rules.n_points), own).finite().points
        return Scan(path, points, cKDTree(points, balanced_tree=False))

    console = Console(stderr=True)
    drawn = []
    for pair in track(pairs, "Reading pairs", console=console, disable=not console.is_terminal):
        both = f"{names[pair.source]}\n{names[pair.target]}"
        rng = np.random.default_rng(derive_seed(seed, zlib.crc32(both.encode())))
        crops = crop_pair(scan(pair.source), scan(pair.target), pair.motion, rules, rng)
        if crops is not None:
            drawn.append((pair, crops))
    return drawn


def _dataset(
    folder: Path, listed: Listed, splits: list[str], drawn: list[tuple[ScanPair, PairCrops]]
) -> CloudDataset:
    clouds: dict[str, Clouds] = {}
    notes: dict[str, Any] = {"left_out_pairs": len(listed.pairs) - len(drawn)}
    for split in SPLITS:
        mine = [(pair, crops) for pair, crops in drawn if splits[pair.source] == split]
        if not mine:
            raise UserError(
                f"root: {folder} has no {split} pair: {notes['left_out_pairs']} of "
                f"{len(listed.pairs)} pairs are left out, whose scans are in different splits or "
                "overlap less than min_overlap."
            )
        pairs, crops = zip(*mine, strict=True)
        notes[f"{split}_pairs"] = facts = _facts(pairs, crops)
        print(f"{folder}: {_said(split, facts)}", file=sys.stderr)
        each = len(crops[0].source)
        labels = torch.tensor([listed.scenes[pair.source] for pair in pairs])
        clouds[split] = Clouds(
            torch.cat([one.source for one in crops]),
            labels.repeat_interleave(each),
            torch.from_numpy(_groups(pairs, len(listed.scans))).repeat_interleave(each),
            TruePairs(*map(torch.cat, zip(*(one.pairs for one in crops), strict=True))),
        )
    found = choose_and_fingerprint("scan_pairs", clouds, listed.names, None, folder)
    return CloudDataset(found.class_names, found.train, found.test, found.fingerprint, notes)


def _groups(pairs: Sequence[ScanPair], scans: int) -> NDArray[np.int64]:
    """Return a number per pair; pairs that are linked by common scans have the same one."""
    ends = np.array([(pair.source, pair.target) for pair in pairs]).T
    links = coo_array((np.ones(len(pairs)), (ends[0], ends[1])), (scans, scans))
    return connected_components(links, directed=False)[1][ends[0]].astype(np.int64)


def _facts(pairs: Sequence[ScanPair], crops: Sequence[PairCrops]) -> dict[str, Any]:
    """Return the number of pairs, and least, mean and largest overlaps and motions."""
    rotations = torch.from_numpy(np.stack([pair.motion[:3, :3] for pair in pairs]))
    turns = quaternion_from_matrix(rotations)
    angles = torch.rad2deg(rotation_angle(turns, torch.eye(4)[:1].to(turns).expand_as(turns)))
    values = {
        "overlap": np.array([one.overlap for one in crops]),
        "crop_overlap": np.concatenate([one.crop_overlaps for one in crops]),
        "rotation_deg": angles.numpy(),
        "translation": np.concatenate([one.shifts for one in crops]),
    }
    spread = {
        name: [float(f"{f(one):.4g}") for f in (np.min, np.mean, np.max)]
        for name, one in values.items()
    }
    return {"number": len(pairs), **spread}


def _said(split: str, facts: dict[str, Any]) -> str:
    """Say a split's facts in two sentences."""
    ranges = {
        name: f"{facts[name][0]:.3g} to {facts[name][2]:.3g}"
        for name in ("overlap", "crop_overlap", "rotation_deg", "translation")
    }
    differ = facts["crop_overlap"] != facts["overlap"]
    crops = f" (crops: {ranges['crop_overlap']})" if differ else ""
    return (
        f"{split} pairs: {facts['number']}, overlap {ranges['overlap']}"
        f"{crops}, rotation "
        f"{ranges['rotation_deg']}°, translation {ranges['translation']}. Errors of predicting no "
        f"motion: {facts['rotation_deg'][1]:.3g}° and {facts['translation'][1]:.3g}."
    )
