"""Points on procedural shapes of random form and proportions."""

import zlib
from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np
import trimesh
from numpy.random import Generator, SeedSequence
from numpy.typing import NDArray
from trimesh import Trimesh

from mops_lightning.data.procedural.airplane import airplane
from mops_lightning.data.procedural.beds import bed
from mops_lightning.data.procedural.desks import desk
from mops_lightning.data.procedural.furniture import lamp, shelf, table
from mops_lightning.data.procedural.seats import chair, sofa, stool
from mops_lightning.data.procedural.vessels import bottle, bowl, bucket, cup, goblet, teapot, vase
from mops_lightning.ops.points import UnitSphere

BUILDERS: Mapping[str, Callable[[Generator], Trimesh]] = MappingProxyType(
    {
        "airplane": airplane,
        "bed": bed,
        "bottle": bottle,
        "bowl": bowl,
        "bucket": bucket,
        "chair": chair,
        "cup": cup,
        "desk": desk,
        "goblet": goblet,
        "lamp": lamp,
        "shelf": shelf,
        "sofa": sofa,
        "stool": stool,
        "table": table,
        "teapot": teapot,
        "vase": vase,
    }
)
"""Builders by class name; each call draws new proportions."""

STRETCH = (0.15, 0.3, 0.15)
"""Largest random scaling of x, y, z, as a natural logarithm, so that proportions differ."""

YAW = np.radians(30)
"""Largest random rotation about the up axis, in radians."""


def sampled_shape(
    class_name: str, n_points: int, seed: int, split: int, number: int
) -> tuple[NDArray[np.float32], NDArray[np.str_]]:
    """Build a shape and sample its surface, uniformly by area.

    Form and points have separate random streams, so that the form does not depend on ``n_points``.

    Args:
        class_name: of the shape.
        n_points: number of points.
        seed: of the data set.
        split: 0 for training, 1 for test.
        number: of the shape among those of its class in the split.

    Returns:
        The points ``(n_points, 3)`` in the unit sphere, and the names of their parts, which are
        empty where the shape does not know its parts.
    """
    form, spread = random_streams(class_name, seed, split, number)
    mesh, angle = built(class_name, form)
    surface_seed = int(spread.generate_state(1, np.uint64)[0])
    surface, faces = trimesh.sample.sample_surface(mesh, n_points, seed=surface_seed)
    cloud = np.asarray(surface) @ rotation_about_y(angle)
    return UnitSphere.around(cloud).normalise(cloud).numpy(), parts_of_faces(mesh)[faces]


def random_streams(
    class_name: str, seed: int, split: int, number: int, streams: int = 2
) -> list[SeedSequence]:
    """Return independent random streams of one shape; the first is the stream of its form.

    Args:
        class_name: of the shape.
        seed: of the data set.
        split: 0 for training, 1 for test.
        number: of the shape among those of its class in the split.
        streams: their number.
    """
    key = (split, zlib.crc32(class_name.encode()), number)
    return SeedSequence(seed, spawn_key=key).spawn(streams)


def built(class_name: str, form: SeedSequence) -> tuple[Trimesh, float]:
    """Build a shape; also return the angle in radians by which it is to be turned about y."""
    rng = np.random.default_rng(form)
    mesh = BUILDERS[class_name](rng)
    mesh.vertices *= np.exp(rng.uniform(-1, 1, 3) * STRETCH)
    return mesh, rng.uniform(-YAW, YAW)


def parts_of_faces(mesh: Trimesh) -> NDArray[np.str_]:
    """Return the name of every face's part; empty where the shape does not know its parts."""
    names: NDArray[np.str_] = mesh.metadata.get("parts", np.full(len(mesh.faces), ""))
    return names


def rotation_about_y(angle: float) -> NDArray[np.float64]:
    """Return the matrix that rotates row vectors about the up axis, by an angle in radians."""
    cos = np.cos(angle)
    sin = np.sin(angle)
    return np.array(((cos, 0, -sin), (0, 1, 0), (sin, 0, cos)))
