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
from typing import Any, Literal

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
from mops_lightning.data.surfaces import FLOAT, PART, cached
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

PARTS: Mapping[str, tuple[str, ...]] = MappingProxyType({
    "airplane": ("hull", "wing", "tail", "engine"),
    "bed": ("frame", "mattress", "pillow", "board", "leg"),
    "chair": ("seat", "back", "leg", "arm"),
    "cup": ("vessel", "handle", "saucer"),
    "lamp": ("base", "pole", "shade"),
    "stool": ("seat", "leg"),
    "table": ("top", "leg"),
    "teapot": ("vessel", "lid", "spout", "handle"),
})  # fmt: skip
"""The classes whose shapes know their parts, for segmentation. Parts of one name are one part."""

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
    classes: Sequence[str] | Literal["asymmetric", "parts"] | None = None,
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
        classes: names to keep, or ``asymmetric`` for ``ASYMMETRIC``, or ``parts`` for those of
            ``PARTS``; None or empty means all.
        seed: seed of all shapes and points.
        cache: folder for generated clouds, or None. A damaged file is generated again.

    Returns:
        Float32 clouds ``(S, n_points, 3)`` in the unit sphere, with the centroid at the origin, and
        int64 labels ``(S,)``; of the classes in ``PARTS`` alone, also the parts of the points. The
        fingerprint depends on all arguments except ``cache``, and on the version of the generator.

    Raises:
        UserError: an argument is invalid, or ``cache`` cannot be written.
    """
    counts = (train_per_class, test_per_class)
    values = (n_points, *counts, seed)
    names = ("n_points", "train_per_class", "test_per_class", "seed")
    for name, value, minimum in zip(names, values, (1, 1, 1, 0), strict=True):
        if not isinstance(value, int) or isinstance(value, bool) or value < minimum:
            raise UserError(f"{name} must be a whole number of at least {minimum}, got {value!r}.")
    named_sets = {"asymmetric": ASYMMETRIC, "parts": tuple(PARTS)}
    wanted = named_sets.get(classes, classes) if isinstance(classes, str) else classes
    chosen = choose_classes(wanted, tuple(BUILDERS))
    labelled = set(chosen) <= set(PARTS)
    part_names = tuple(dict.fromkeys(sum((PARTS[name] for name in chosen), ()))) if labelled else ()
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
    sizes = [(count * len(chosen), n_points) for count in counts]
    kinds = [((*size, 3), FLOAT) for size in sizes] + [(size, PART) for size in sizes if part_names]
    arrays = cached(path, kinds, lambda: _generate(n_points, counts, chosen, seed, part_names))
    train, test = (
        Clouds(
            torch.from_numpy(arrays[split]),
            torch.arange(len(chosen)).repeat_interleave(count),
            parts=torch.from_numpy(arrays[2 + split]) if part_names else None,
        )
        for split, count in enumerate(counts)
    )
    return CloudDataset(chosen, train, test, fingerprint, part_names=part_names)


def _generate(
    n_points: int,
    counts: tuple[int, int],
    chosen: Sequence[str],
    seed: int,
    part_names: Sequence[str],
) -> list[NDArray[Any]]:
    """Return the clouds of both splits, ``(S, n_points, 3)``, class by class, then their parts."""
    jobs = [
        (name, split, i)
        for split, count in enumerate(counts)
        for name in chosen
        for i in range(count)
    ]
    # Not rich's is_terminal, which FORCE_COLOR makes true for log files.
    silent = not sys.stderr.isatty()
    console = Console(stderr=True)
    progress = track(jobs, "Making shapes", console=console, transient=True, disable=silent)
    clouds, names = zip(
        *(_cloud(name, n_points, seed, split, i) for name, split, i in progress), strict=True
    )
    first = counts[0] * len(chosen)
    arrays = np.split(np.stack(clouds), [first])
    if part_names:
        order = np.argsort(part_names)
        numbers = order[np.searchsorted(part_names, np.stack(names), sorter=order)]
        arrays += np.split(numbers.astype(PART), [first])
    return arrays


def _cloud(
    name: str, n_points: int, seed: int, split: int, i: int
) -> tuple[NDArray[np.float32], NDArray[np.str_]]:
    """Build shape i of a class in a split and sample it: ``(n_points, 3)``, and the parts' names.

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
    sampled, faces = trimesh.sample.sample_surface(mesh, n_points, seed=number)
    cloud = np.asarray(sampled) @ ((cos, 0, -sin), (0, 1, 0), (sin, 0, cos))
    parts = mesh.metadata.get("parts", np.full(len(mesh.faces), ""))
    return UnitSphere.around(cloud).normalise(cloud).numpy(), parts[faces]
