"""Procedural scans: shapes on a floor with clutter, seen by a laser scanner; no download.

Shapes are those of ``shapes``. Most points are not on the shape, and some are outliers.
"""

import hashlib
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from mops_lightning.channels import NORMAL_COLUMNS, NORMALS
from mops_lightning.data import shapes
from mops_lightning.data.clouds import CloudDataset, Clouds
from mops_lightning.data.features import (
    ESTIMATED,
    channels_of,
    check_features,
    feature_values,
    with_channels,
)
from mops_lightning.data.formats.table import Table
from mops_lightning.data.surfaces import FLOAT, PART, Kind, cached
from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.filesystem import remove_temporary
from mops_lightning.ops.normals import estimate_normals
from mops_lightning.ops.points import UnitSphere

INTENSITY = "intensity"
FEATURES = (INTENSITY, *ESTIMATED)
"""What points have beside x, y and z, as ``dataset.features`` names it."""

OBJECT = "object"
SURROUNDINGS = ("floor", "clutter", "outlier")
"""Parts of every scan beside those of its shape."""

GENERATOR_VERSION = 1
"""Part of the fingerprint, beside ``shapes.GENERATOR_VERSION``; increment it with every change."""


def scans_of_shapes(
    n_points: int = 1024,
    train_per_class: int = 80,
    test_per_class: int = 20,
    classes: Sequence[str] | Literal["asymmetric", "parts"] | None = None,
    outliers: float = 0.06,
    noise: float = 0.01,
    features: Sequence[str] | None = None,
    seed: int = 0,
    cache: str | Path | None = None,
) -> CloudDataset:
    """Generate scans of the 16 classes of ``shapes``.

    Each shape stands on a floor with one to four other things, and is scanned by rays from one to
    three places. About a fifth of the points is on the shape. Scan i of a class in a split depends
    on (seed, split, class, i), ``n_points``, ``outliers`` and ``noise`` only; y is up.

    Args:
        n_points: number of points per scan.
        train_per_class: number of training scans per class.
        test_per_class: number of test scans per class.
        classes: as for ``shapes.shapes``.
        outliers: largest share of outliers, below 1; each scan draws its own between 0 and this.
        noise: standard deviation of the range; the longest side of a shape is 1.
        features: channels beside x, y and z, in this order: ``intensity``, which falls with the
            angle of incidence; ``normals`` and ``curvature``, estimated from the points of the
            scan. None: no channels.
        seed: seed of all scans.
        cache: folder for generated scans, or None. A damaged file is generated again.

    Returns:
        Float32 clouds ``(S, n_points, 3 + C)`` in the unit sphere, int64 labels ``(S,)`` and parts
        ``(S, n_points)``: floor, clutter, outlier, and the parts of the shapes in
        ``shapes.PARTS``, or ``object`` if a class is not among them.

    Raises:
        UserError: an argument is invalid, or ``cache`` cannot be written.
    """
    shapes.check_number(1, train_per_class=train_per_class)
    shapes.check_number(1, test_per_class=test_per_class)
    chosen = shapes.chosen_classes(classes)
    maker = ScanMaker.of(n_points, outliers, noise, seed, features, chosen)
    counts = (train_per_class, test_per_class)
    fingerprint = maker.fingerprint(counts, chosen)
    path = None
    if cache is not None:
        path = Path(cache).expanduser() / f"scans-of-shapes-{fingerprint[:20]}.npz"
        remove_temporary(path.parent, below=False)

    def make() -> list[NDArray[Any]]:
        arrays: list[NDArray[Any]] = []
        for split, count in enumerate(counts):
            arrays += maker.split(split, count, chosen)
        return arrays

    kinds: list[Kind] = []
    for count in counts:
        kinds += maker.kinds(count * len(chosen))
    arrays = cached(path, kinds, make)
    features_of_training = arrays[2].astype(np.float64)
    channels = channels_of(maker.features, [features_of_training])
    splits = []
    for split, count in enumerate(counts):
        places, parts, values = arrays[3 * split : 3 * split + 3]
        points = with_channels(torch.from_numpy(places), values.astype(np.float64), channels)
        labels = torch.arange(len(chosen)).repeat_interleave(count)
        splits.append(Clouds(points, labels, parts=torch.from_numpy(parts)))
    train, test = splits
    return CloudDataset(
        chosen, train, test, fingerprint, part_names=maker.part_names, channels=channels
    )


@dataclass(frozen=True)
class ScanMaker:
    """Makes the scans of a data set; the attributes are arguments of ``scans_of_shapes``.

    Attributes:
        part_names: in the order of their numbers.
    """

    n_points: int
    outliers: float
    noise: float
    seed: int
    features: tuple[str, ...]
    part_names: tuple[str, ...]

    @classmethod
    def of(
        cls,
        n_points: int,
        outliers: float,
        noise: float,
        seed: int,
        features: Sequence[str] | None,
        classes: Sequence[str],
    ) -> "ScanMaker":
        """Check the arguments.

        Raises:
            UserError: one of them is invalid.
        """
        shapes.check_number(1, n_points=n_points)
        shapes.check_number(0, seed=seed)
        if not _is_number(outliers) or not 0 <= outliers < 1:
            raise UserError(f"outliers must be a share from 0 to below 1, got {outliers!r}.")
        if not _is_number(noise) or not 0 <= noise < float("inf"):
            raise UserError(f"noise must be a number of at least 0, got {noise!r}.")
        names = check_features(features)
        for name in names:
            if name not in FEATURES:
                raise UserError(
                    f"features: scans of shapes have {', '.join(FEATURES)}, got {name!r}."
                    f"{did_you_mean(name, FEATURES)}"
                )
        of_shapes = shapes.part_names_of(classes) or (OBJECT,)
        parts = (*of_shapes, *SURROUNDINGS)
        return cls(n_points, float(outliers), float(noise), seed, names, parts)

    def fingerprint(self, counts: tuple[int, int], classes: Sequence[str]) -> str:
        """Return the sha256 of all that determines the content of both splits."""
        settings = {
            "dataset": "scans_of_shapes",
            "version": (GENERATOR_VERSION, shapes.GENERATOR_VERSION),
            "n_points": self.n_points,
            "per_class": counts,
            "classes": classes,
            "outliers": self.outliers,
            "noise": self.noise,
            "features": self.features,
            "seed": self.seed,
        }
        return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()

    def kinds(self, scans: int) -> list[Kind]:
        """Return shapes and types of the arrays of a split: points, parts and features."""
        width = 0
        for name in self.features:
            width += len(NORMAL_COLUMNS) if name == NORMALS else 1
        return [
            ((scans, self.n_points, 3), FLOAT),
            ((scans, self.n_points), PART),
            ((scans, self.n_points, width), FLOAT),
        ]

    def split(self, split: int, count: int, classes: Sequence[str]) -> list[NDArray[Any]]:
        """Return the points, parts and features of a split, class by class."""
        jobs = []
        for class_name in classes:
            for number in range(count):
                jobs.append((class_name, number))
        # Not rich's is_terminal, which FORCE_COLOR makes true for log files.
        silent = not sys.stderr.isatty()
        console = Console(stderr=True)
        scans = []
        for class_name, number in track(
            jobs, "Making scans", console=console, transient=True, disable=silent
        ):
            scans.append(self.scan(class_name, split, number))
        points, parts, values = zip(*scans, strict=True)
        return [np.stack(points), np.stack(parts), np.stack(values)]

    def scan(
        self, class_name: str, split: int, number: int
    ) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.float32]]:
        """Return the points ``(N, 3)``, parts ``(N,)`` and features ``(N, C)`` of one scan."""
        # Imported here: most runs find their scans in the cache and need no builder.
        from mops_lightning.data.procedural.scenes import scan_of_shape

        scan = scan_of_shape(
            class_name,
            self.n_points,
            self.outliers,
            self.noise,
            seed=self.seed,
            split=split,
            number=number,
        )
        parts = np.empty(self.n_points, PART)
        for place, name in enumerate(self.part_names):
            parts[scan.parts == name] = place
        if OBJECT in self.part_names:
            parts[~np.isin(scan.parts, SURROUNDINGS)] = self.part_names.index(OBJECT)
        values = np.empty((self.n_points, 0))
        if self.features:
            columns = {INTENSITY: scan.intensities}
            if NORMALS in self.features:
                columns |= zip(NORMAL_COLUMNS, _upward_normals(scan.points).T, strict=True)
            table = Table(scan.points, columns)
            values = feature_values(table, self.features, Path("scan"), "features")
        points = UnitSphere.around(scan.points).normalise(scan.points).numpy()
        return points, parts, values.astype(np.float32)


def _is_number(value: Any) -> bool:
    return isinstance(value, float | int) and not isinstance(value, bool)


def _upward_normals(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return estimated normals ``(N, 3)`` with the sign that points upwards; here y is up."""
    normals = estimate_normals(points)
    normals[normals[:, 1] < 0] *= -1
    return normals
