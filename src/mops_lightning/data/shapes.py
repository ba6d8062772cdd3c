"""A procedural dataset of furniture, vessels and airplanes that needs no download.

It replaces the paper's ModelNet40 in quick starts, tests and demonstrations.
"""

import hashlib
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from mops_lightning.data.clouds import CloudDataset, Clouds, choose_classes
from mops_lightning.data.surfaces import FLOAT, PART, Kind, cached
from mops_lightning.errors import UserError
from mops_lightning.filesystem import remove_temporary

CLASSES = (
    "airplane",
    "bed",
    "bottle",
    "bowl",
    "bucket",
    "chair",
    "cup",
    "desk",
    "goblet",
    "lamp",
    "shelf",
    "sofa",
    "stool",
    "table",
    "teapot",
    "vase",
)
"""All classes, in the order of their labels."""

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
    check_number(1, n_points=n_points)
    check_number(1, train_per_class=train_per_class)
    check_number(1, test_per_class=test_per_class)
    check_number(0, seed=seed)
    chosen = chosen_classes(classes)
    part_names = part_names_of(chosen)
    counts = (train_per_class, test_per_class)
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

    kinds: list[Kind] = []
    for count in counts:
        kinds.append(((count * len(chosen), n_points, 3), FLOAT))
    if part_names:
        for count in counts:
            kinds.append(((count * len(chosen), n_points), PART))
    arrays = cached(path, kinds, lambda: _generate(n_points, counts, chosen, seed, part_names))

    splits = []
    for split, count in enumerate(counts):
        points = torch.from_numpy(arrays[split])
        labels = torch.arange(len(chosen)).repeat_interleave(count)
        parts = torch.from_numpy(arrays[2 + split]) if part_names else None
        splits.append(Clouds(points, labels, parts=parts))
    train, test = splits
    return CloudDataset(chosen, train, test, fingerprint, part_names=part_names)


def check_number(minimum: int, **argument: Any) -> None:
    """Refuse a value that is not a whole number of at least ``minimum``."""
    ((name, value),) = argument.items()
    is_number = isinstance(value, int) and not isinstance(value, bool)
    if not is_number or value < minimum:
        raise UserError(f"{name} must be a whole number of at least {minimum}, got {value!r}.")


def chosen_classes(
    classes: Sequence[str] | Literal["asymmetric", "parts"] | None,
) -> tuple[str, ...]:
    """Return the classes that the argument ``classes`` names, in the order of their labels."""
    if classes == "asymmetric":
        return choose_classes(ASYMMETRIC, CLASSES)
    if classes == "parts":
        return choose_classes(tuple(PARTS), CLASSES)
    return choose_classes(classes, CLASSES)


def part_names_of(chosen: Sequence[str]) -> tuple[str, ...]:
    """Return the parts of the classes, each once; none if a class does not know its parts."""
    if not set(chosen) <= set(PARTS):
        return ()
    names: list[str] = []
    for class_name in chosen:
        names.extend(name for name in PARTS[class_name] if name not in names)
    return tuple(names)


def _generate(
    n_points: int,
    counts: tuple[int, int],
    chosen: Sequence[str],
    seed: int,
    part_names: Sequence[str],
) -> list[NDArray[Any]]:
    """Return the clouds of both splits, ``(S, n_points, 3)``, class by class, then their parts."""
    # Imported here: most runs find their shapes in the cache and need no builder.
    from mops_lightning.data.procedural.sampled import sampled_shape

    jobs = []
    for split, count in enumerate(counts):
        for class_name in chosen:
            for number in range(count):
                jobs.append((class_name, split, number))
    # Not rich's is_terminal, which FORCE_COLOR makes true for log files.
    silent = not sys.stderr.isatty()
    console = Console(stderr=True)
    clouds = []
    names_of_parts = []
    for class_name, split, number in track(
        jobs, "Making shapes", console=console, transient=True, disable=silent
    ):
        cloud, names = sampled_shape(class_name, n_points, seed, split, number)
        clouds.append(cloud)
        names_of_parts.append(names)
    first_test = counts[0] * len(chosen)
    arrays = np.split(np.stack(clouds), [first_test])
    if part_names:
        order = np.argsort(part_names)
        numbers = order[np.searchsorted(part_names, np.stack(names_of_parts), sorter=order)]
        arrays += np.split(numbers.astype(PART), [first_test])
    return arrays
