"""Procedural furniture, vessels and airplanes: a dataset that needs no download.

It stands in wherever the paper's ModelNet40 is not at hand: quick starts, tests, demonstrations.
"""

import hashlib
import json
import sys
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
import trimesh
from numpy.random import SeedSequence
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from mops_lightning.data.clouds import CloudDataset, Clouds, choose_classes
from mops_lightning.data.procedural.builders import BUILDERS
from mops_lightning.errors import UserError
from mops_lightning.files import atomic_write

GENERATOR_VERSION = 1
"""To be raised with every change of the shapes: it makes old cache files and weights unused."""

STRETCH = (0.15, 0.3, 0.15)
"""Largest random stretch of x, y, z, as a natural logarithm; it blurs what proportions tell."""

YAW = np.radians(30)
"""Largest random turn about the up axis; nobody sets things down quite straight."""


def shapes(
    n_points: int = 1024,
    train_per_class: int = 80,
    test_per_class: int = 20,
    classes: Sequence[str] | None = None,
    seed: int = 0,
    cache: str | Path | None = None,
) -> CloudDataset:
    """Make a dataset of 16 classes of everyday shapes with random form and proportions.

    Some classes are near each other (stool and table, cup and bucket, vase and bottle), and their
    bounding boxes overlap, so that classification needs the parts: a handle, a back, a lip. Shape
    i of a class in a split depends only on (seed, split, class, i): other settings neither change
    it nor its form. Points are uniform by area over all surfaces; y is up, the front looks to +z.

    Args:
        n_points: points per shape.
        train_per_class: training shapes of each class.
        test_per_class: test shapes of each class.
        classes: names to keep; None or empty means all.
        seed: fixes all shapes and points.
        cache: folder to keep the clouds in, or None. A damaged file there is made anew.

    Returns:
        Float32 clouds ``(S, n_points, 3)``, centroid subtracted, largest norm 1; int64 labels
        ``(S,)``. The fingerprint hangs on all settings but ``cache``, and on the generator's
        version.

    Raises:
        UserError: a setting is out of range, a class is unknown, or ``cache`` cannot be written.
    """
    for name, value, least in (
        ("n_points", n_points, 1),
        ("train_per_class", train_per_class, 1),
        ("test_per_class", test_per_class, 1),
        ("seed", seed, 0),
    ):
        if not isinstance(value, int) or isinstance(value, bool) or value < least:
            raise UserError(
                f"dataset.{name} must be a whole number of at least {least}, got {value!r}."
            )
    chosen = _chosen(classes)
    counts = (train_per_class, test_per_class)
    fingerprint = _fingerprint(n_points, counts, chosen, seed)
    expected = [(count * len(chosen), n_points, 3) for count in counts]

    path = None if cache is None else _cache_path(cache, fingerprint)
    points = None if path is None else _load(path, expected)
    if points is None:
        points = _generate(expected, counts, chosen, seed)
        if path is not None:
            _save(path, points)
    train, test = (
        Clouds(torch.from_numpy(cloud), torch.arange(len(chosen)).repeat_interleave(count))
        for cloud, count in zip(points, counts, strict=True)
    )
    return CloudDataset(chosen, train, test, fingerprint)


def _chosen(classes: Sequence[str] | None) -> tuple[str, ...]:
    if classes is not None and (
        isinstance(classes, str)
        or not isinstance(classes, Sequence)
        or not all(isinstance(name, str) for name in classes)
    ):
        raise UserError(
            f"dataset.classes must be a list of names, got {classes!r}. "
            f"Allowed: {', '.join(BUILDERS)}."
        )
    return choose_classes(classes, tuple(BUILDERS))


def _fingerprint(n_points: int, counts: tuple[int, int], chosen: Sequence[str], seed: int) -> str:
    settings = {
        "dataset": "shapes",
        "version": GENERATOR_VERSION,
        "n_points": n_points,
        "per_class": counts,
        "classes": chosen,
        "seed": seed,
    }
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()


def _generate(
    expected: Sequence[tuple[int, int, int]],
    counts: tuple[int, int],
    chosen: Sequence[str],
    seed: int,
) -> list[NDArray[np.float32]]:
    points = [np.empty(shape, dtype=np.float32) for shape in expected]
    jobs = [
        (split, label * count + i, name, i)
        for split, count in enumerate(counts)
        for label, name in enumerate(chosen)
        for i in range(count)
    ]
    # Asked of the stream itself: FORCE_COLOR makes rich take a log file for a terminal.
    silent = not sys.stderr.isatty()
    for split, row, name, i in track(
        jobs,
        "Making shapes",
        console=Console(stderr=True),
        transient=True,
        disable=silent,
    ):
        points[split][row] = _cloud(name, expected[split][1], seed, split, i)
    return points


def _cloud(name: str, n_points: int, seed: int, split: int, i: int) -> NDArray[np.float32]:
    """Build shape i of a class in a split and sample it: ``(n_points, 3)``.

    The form and the points have streams of their own, so the form is the same for any number of
    points.
    """
    key = (split, zlib.crc32(name.encode()), i)
    form, spread = SeedSequence(seed, spawn_key=key).spawn(2)
    rng = np.random.default_rng(form)
    mesh = BUILDERS[name](rng)
    mesh.vertices *= np.exp(rng.uniform(-1, 1, 3) * STRETCH)
    turn = rng.uniform(-YAW, YAW)
    cos, sin = np.cos(turn), np.sin(turn)
    cloud = _sample(mesh, n_points, spread) @ ((cos, 0, -sin), (0, 1, 0), (sin, 0, cos))
    cloud -= cloud.mean(0)
    # A single point is its own centroid and stays at the origin.
    return (cloud / max(np.linalg.norm(cloud, axis=1).max(), 1e-12)).astype(np.float32)


def _sample(mesh: trimesh.Trimesh, n_points: int, seed: SeedSequence) -> NDArray[np.float64]:
    """Draw points uniformly by area: ``(n_points, 3)``."""
    number = int(seed.generate_state(1, np.uint64)[0])
    return np.asarray(trimesh.sample.sample_surface(mesh, n_points, seed=number)[0])


def _cache_path(cache: str | Path, fingerprint: str) -> Path:
    folder = Path(cache).expanduser()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(folder, error) from error
    return folder / f"shapes-{fingerprint[:20]}.npz"


def _load(path: Path, expected: Sequence[tuple[int, int, int]]) -> list[NDArray[np.float32]] | None:
    """Read a cache file, or return None when it is absent, damaged or of another shape."""
    try:
        # The archive carries a checksum of each array, which reading verifies.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            points = [file["train"], file["test"]]
    except Exception:  # zipfile and numpy answer damage with a dozen kinds of exception
        return None
    whole = all(
        cloud.shape == shape and cloud.dtype == np.float32
        for cloud, shape in zip(points, expected, strict=True)
    )
    return points if whole else None


def _save(path: Path, points: Sequence[NDArray[np.float32]]) -> None:
    try:
        with atomic_write(path) as temporary:
            np.savez(temporary, train=points[0], test=points[1])
    except OSError as error:
        raise _unwritable(path.parent, error) from error


def _unwritable(folder: Path, error: OSError) -> UserError:
    return UserError(
        f"dataset.cache: cannot write to {folder} ({error}). Set it to a folder that can be "
        "written, or to null for no cache."
    )
