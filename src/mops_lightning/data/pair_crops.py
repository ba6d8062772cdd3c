"""Crops of two scans around common places, normalised together."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mops_lightning.data.crops import DRAWS, Cloud, Crop, check_number, in_cube, nearest
from mops_lightning.data.formats.errors import BadCloudError
from mops_lightning.data.motions import Matrix
from mops_lightning.errors import UserError
from mops_lightning.ops.rigid import quaternion_from_matrix
from mops_lightning.types import TruePairs

PROBES = 2000
"""Points of the source on which the overlap is measured."""

OVERLAP_DISTANCE = 0.03
"""Default of ``overlap_distance``: this share of the source's median distance from its centroid."""


class Scan(NamedTuple):
    """A scan: its path, for errors, its points ``(N, 3)`` in its own unit, and their tree."""

    path: Path
    points: Cloud
    tree: Any


class CropRules(NamedTuple):
    """How crops are drawn; see ``scan_pairs`` for the values."""

    n_points: int
    number: int
    crop: Crop
    size: float | None
    overlap_distance: float | None
    min_overlap: float


class PairCrops(NamedTuple):
    """Crops of one pair of scans.

    Attributes:
        source: ``(K, n_points, 3)`` float32, centred and scaled.
        pairs: the targets and the true motions.
        overlap: share of the source scan's points that have a target point near them.
        crop_overlaps: ``(K,)`` the same of the crops, before points are drawn from the target's.
        shifts: ``(K,)`` how far the motion moves the place where translation errors are measured,
            in the scans' own unit: the error of predicting no motion.
    """

    source: torch.Tensor
    pairs: TruePairs
    overlap: float
    crop_overlaps: NDArray[np.float64]
    shifts: NDArray[np.float64]


def moved(points: Cloud, motion: Matrix) -> Cloud:
    """Return points ``(..., 3)`` under a rigid motion ``(4, 4)``: R·p + t."""
    return points @ motion[:3, :3].T + motion[:3, 3]


def crop_pair(
    source: Scan, target: Scan, motion: Matrix, rules: CropRules, rng: np.random.Generator
) -> PairCrops | None:
    """Draw crops of two scans around places that both contain.

    Args:
        source: the scan that the motion moves.
        target: the scan to which it moves it.
        motion: ``(4, 4)`` true rigid motion.
        rules: how crops are drawn.
        rng: draws all of this.

    Returns:
        K crops, with all coordinates divided by one number per crop, so that source and target are
        in the unit sphere around their centroids and the motion stays rigid. None: the overlap is
        below ``min_overlap``.

    Raises:
        UserError: the scans do not overlap and ``min_overlap`` is 0, or have too few points.
    """
    for one in (source, target):
        check_number(one.points, rules.n_points, one.path)
    limit = rules.overlap_distance or OVERLAP_DISTANCE * _extent(source.points)
    rows = rng.permutation(len(source.points))[:PROBES]
    probes = source.points[rows]
    near = _near(moved(probes, motion), target.tree, limit)
    if near.mean() < rules.min_overlap:
        return None
    if not near.any():
        raise UserError(
            f"motions: {source.path} and {target.path} do not overlap: no source point comes "
            f"within overlap_distance={limit:.3g} of a target point. Check direction and unit of "
            "the motions, or leave such pairs out: dataset.min_overlap=0.1."
        )
    places = probes[near]
    crops, overlaps, shifts = [], [], []
    for _ in range(rules.number):
        crop, centre, overlap = _usable(source, target, motion, rules, places, limit, rng)
        crops.append(crop)
        overlaps.append(near.mean() if overlap is None else overlap)
        shifts.append(np.linalg.norm(moved(centre, motion) - centre))
    own, *others = (torch.stack(parts) for parts in zip(*crops, strict=True))
    pairs = TruePairs(*others)
    return PairCrops(own, pairs, float(near.mean()), np.array(overlaps), np.array(shifts))


def _extent(points: Cloud) -> float:
    return float(np.median(np.linalg.norm(points - points.mean(0), axis=1)))


def _near(points: Cloud, tree: Any, limit: float) -> NDArray[np.bool_]:
    """Return which points have a point of the tree within a distance."""
    return np.isfinite(tree.query(points, distance_upper_bound=limit)[0])


def _usable(
    source: Scan,
    target: Scan,
    motion: Matrix,
    rules: CropRules,
    places: Cloud,
    limit: float,
    rng: np.random.Generator,
) -> tuple[tuple[torch.Tensor, ...], Cloud, float | None]:
    """Draw until both crops have enough points that do not all coincide.

    Returns:
        A crop of ``_normalised``, its centre and its overlap; None if the crops are whole scans.
    """
    largest = 0
    for _ in range(DRAWS):
        centre = places[rng.integers(len(places))] if rules.crop != "whole" else np.zeros(3)
        regions = (
            _region(source.points, centre, rules),
            _region(target.points, moved(centre, motion), rules),
        )
        fewest = min(map(len, regions))
        largest = max(largest, fewest)
        if fewest < rules.n_points:
            continue
        own, other = (
            one[np.sort(rng.choice(len(one), rules.n_points, replace=False))] for one in regions
        )
        if (own == own[0]).all() or (other == other[0]).all():
            continue
        overlap = None
        if rules.crop != "whole":
            overlap = _near(moved(own, motion), cKDTree(regions[1]), limit).mean()
        return _normalised(own, other, motion, centre), centre, overlap
    if rules.size is not None and largest < rules.n_points:
        raise BadCloudError(
            f"{source.path} and {target.path}: crop_size={rules.size:g} is too small for n_points="
            f"{rules.n_points}: the fullest of {DRAWS} pairs of cubes have {largest} points. "
            "Increase crop_size or lower n_points."
        )
    raise BadCloudError(
        f"{source.path} and {target.path}: the points of a crop coincide. Clean the files."
    )


def _region(points: Cloud, centre: Cloud, rules: CropRules) -> Cloud:
    if rules.crop == "nearest":
        return nearest(points, centre, rules.n_points)
    if rules.crop == "cube":
        return points[in_cube(points, centre, rules.size or 0.0)]
    return points


def _normalised(
    source: Cloud, target: Cloud, motion: Matrix, centre: Cloud
) -> tuple[torch.Tensor, ...]:
    """Centre and scale both clouds, and express the motion in the new coordinates.

    With p = s·p' + a and q = s·q' + b, q = R·p + t becomes q' = R·p' + (R·a + t - b)/s.

    Args:
        source: ``(n, 3)`` in the data's own unit.
        target: ``(n, 3)``.
        motion: ``(4, 4)``.
        centre: ``(3,)`` where translation errors are measured, in the source's coordinates.

    Returns:
        The source, and the attributes of ``TruePairs``, without the dimension of the batch.
    """
    a, b = source.mean(0), target.mean(0)
    # In float64: float32 has too few digits for coordinates of a map.
    source, target = source - a, target - b
    scale = max(np.linalg.norm(one, axis=1).max() for one in (source, target))
    translation = (moved(a, motion) - b) / scale
    parts = (source / scale, target / scale, translation, (centre - a) / scale, np.array(scale))
    own, other, shift, origin, unit = (torch.from_numpy(one).float() for one in parts)
    quaternion = quaternion_from_matrix(torch.from_numpy(motion[:3, :3])).float()
    return own, other, quaternion, shift, origin, unit
