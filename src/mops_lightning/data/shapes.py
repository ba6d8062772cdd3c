"""A procedural dataset of furniture, vessels and airplanes that needs no download.

It replaces the paper's ModelNet40 in quick starts, tests and demonstrations.
"""

import hashlib
import json
import sys
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import numpy as np
import torch
import trimesh
from numpy.random import Generator, SeedSequence
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from mops_lightning.data.clouds import CloudDataset, Clouds, choose_classes
from mops_lightning.data.procedural.airplane import airplane
from mops_lightning.data.procedural.furniture import bed, desk, lamp, shelf, table
from mops_lightning.data.procedural.seats import chair, sofa, stool
from mops_lightning.data.procedural.vessels import bottle, bowl, bucket, cup, goblet, teapot, vase
from mops_lightning.data.surfaces import cached
from mops_lightning.errors import UserError
from mops_lightning.filesystem import remove_temporary
from mops_lightning.ops.points import UnitSphere

BUILDERS: Mapping[str, Callable[[Generator], trimesh.Trimesh]] = MappingProxyType({
    builder.__name__: builder for builder in (
        airplane, bed, bottle, bowl, bucket, chair, cup, desk,
        goblet, lamp, shelf, sofa, stool, table, teapot, vase,
    )
})  # fmt: skip
"""Builders by class name, in the order of the labels; each call draws new proportions."""

ASYMMETRIC = ("airplane", "bed", "chair", "shelf", "sofa", "teapot")
"""Classes whose shapes do not look alike from several sides, for registration."""

GENERATOR_VERSION = 1
"""Part of the fingerprint; increment it with every change of the shapes."""

STRETCH = (0.15, 0.3, 0.15)
"""Largest random scaling of x, y, z, as a natural logarithm, so that proportions differ."""

YAW = np.radians(30)
"""Largest random rotation about the up axis, in radians."""


def shapes(
    n_points: int = 1024,
    train_per_class: int = 80,
    test_per_class: int = 20,
    classes: Sequence[str] | Literal["asymmetric"] | None = None,
    seed: int = 0,
    cache: str | Path | None = None,
) -> CloudDataset:
    """Generate a dataset of 16 classes of everyday shapes with random form and proportions.

    Some classes are similar (stool and table, cup and bucket, vase and bottle), and their bounding
    boxes overlap, so that classification depends on parts such as handles, backs and lips. Shape i
    of a class in a split depends on (seed, split, class, i) only. Points are uniform by area; y is
    up, and the front faces +z.

    Args:
        n_points: number of points per shape.
        train_per_class: number of training shapes per class.
        test_per_class: number of test shapes per class.
        classes: names to keep, or ``asymmetric`` for ``ASYMMETRIC``; None or empty means all.
        seed: seed of all shapes and points.
        cache: folder for generated clouds, or None. A damaged file is generated again.

    Returns:
        Float32 clouds ``(S, n_points, 3)`` in the unit sphere, with the centroid at the origin, and
        int64 labels ``(S,)``. The fingerprint depends on all arguments except ``cache``, and on the
        version of the generator.

    Raises:
        UserError: an argument is invalid, or ``cache`` cannot be written.
    """
    counts = (train_per_class, test_per_class)
    values = (n_points, *counts, seed)
    names = ("n_points", "train_per_class", "test_per_class", "seed")
    for name, value, minimum in zip(names, values, (1, 1, 1, 0), strict=True):
        if not isinstance(value, int) or isinstance(value, bool) or value < minimum:
            raise UserError(f"{name} must be a whole number of at least {minimum}, got {value!r}.")
    wanted = ASYMMETRIC if classes == "asymmetric" else classes
    chosen = choose_classes(wanted, tuple(BUILDERS))
    settings = {
        "dataset": "shapes",
        "version": GENERATOR_VERSION,
        "n_points": n_points,
        "per_class": counts,
        "classes": chosen,
        "seed": seed,
    }
    fingerprint = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()
    path = None
    if cache is not None:
        path = Path(cache).expanduser() / f"shapes-{fingerprint[:20]}.npz"
        remove_temporary(path.parent, below=False)
    expected = [(count * len(chosen), n_points, 3) for count in counts]
    points = cached(path, expected, lambda: _generate(n_points, counts, chosen, seed))
    train, test = (
        Clouds(torch.from_numpy(cloud), torch.arange(len(chosen)).repeat_interleave(count))
        for cloud, count in zip(points, counts, strict=True)
    )
    return CloudDataset(chosen, train, test, fingerprint)


def _generate(
    n_points: int, counts: tuple[int, int], chosen: Sequence[str], seed: int
) -> list[NDArray[np.float32]]:
    """Return the clouds of both splits, ``(S, n_points, 3)``, class by class."""
    jobs = [
        (name, split, i)
        for split, count in enumerate(counts)
        for name in chosen
        for i in range(count)
    ]
    # Not rich's is_terminal, which FORCE_COLOR makes true for log files.
    silent = not sys.stderr.isatty()
    console = Console(stderr=True)
    clouds = np.stack(
        [
            _cloud(name, n_points, seed, split, i)
            for name, split, i in track(
                jobs, "Making shapes", console=console, transient=True, disable=silent
            )
        ]
    )
    return np.split(clouds, [counts[0] * len(chosen)])


def _cloud(name: str, n_points: int, seed: int, split: int, i: int) -> NDArray[np.float32]:
    """Build shape i of a class in a split and sample it: ``(n_points, 3)``.

    Form and points have separate random streams, so that the form does not depend on ``n_points``.
    """
    key = (split, zlib.crc32(name.encode()), i)
    form, spread = SeedSequence(seed, spawn_key=key).spawn(2)
    rng = np.random.default_rng(form)
    mesh = BUILDERS[name](rng)
    mesh.vertices *= np.exp(rng.uniform(-1, 1, 3) * STRETCH)
    angle = rng.uniform(-YAW, YAW)
    cos, sin = np.cos(angle), np.sin(angle)
    number = int(spread.generate_state(1, np.uint64)[0])
    cloud = np.asarray(trimesh.sample.sample_surface(mesh, n_points, seed=number)[0])
    cloud = cloud @ ((cos, 0, -sin), (0, 1, 0), (sin, 0, cos))
    return UnitSphere.around(cloud).normalise(cloud).numpy()
