"""Scenes with one shape on a floor, as a laser scanner sees them from a few places."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from trimesh import Trimesh

from mops_lightning.data.procedural.mesh_parts import around, box, disc, rod, turned
from mops_lightning.data.procedural.rays import (
    NOTHING,
    Array,
    Camera,
    RayGrid,
    Rows,
    nearest_faces,
)
from mops_lightning.data.procedural.sampled import (
    built,
    parts_of_faces,
    random_streams,
    rotation_about_y,
)

OBJECT = "object"
FLOOR = "floor"
CLUTTER = "clutter"
OUTLIER = "outlier"
"""Names of the parts of a scene; an object that knows its parts has their names."""

FLOOR_RADIUS = 1.1
"""Radius of the floor; the longest side of the object is 1."""

MOST_OFFSET = 0.15
"""Largest distance of the object from the middle of the floor along each axis."""

MOST_CLUTTER = 4
MOST_VIEWS = 3
"""Largest numbers of things beside the object and of places of the scanner; the fewest are 1."""

TRIES = 20
"""Places that are tried for a thing beside the object, before it is left out."""

STRAY_HEIGHT = 1.1
"""Stray points are at most this high above the floor."""

STEP = 0.1
"""Neighbouring rays whose depths differ by more are at the edge of something."""

INTENSITY_NOISE = 0.03
"""Standard deviation of the noise of intensities, which are between 0 and 1."""


class Scene(NamedTuple):
    """Triangles of a scene.

    Attributes:
        corners: ``(F, 3, 3)`` of the triangles.
        parts: ``(F,)`` names of their parts.
        albedos: ``(F,)`` the intensities that they have when seen straight on.
    """

    corners: Array
    parts: NDArray[np.str_]
    albedos: Array


class Scan(NamedTuple):
    """What a scanner saw.

    Attributes:
        points: ``(N, 3)`` places, y up, the floor at y = 0.
        parts: ``(N,)`` names of the parts that they are on.
        intensities: ``(N,)`` between 0 and 1.
    """

    points: Array
    parts: NDArray[np.str_]
    intensities: Array

    def take(self, rows: Rows) -> "Scan":
        """Return some of the points."""
        points = self.points[rows]
        parts = self.parts[rows]
        return Scan(points, parts, self.intensities[rows])


def scan_of_shape(
    class_name: str,
    n_points: int,
    outliers: float,
    noise: float,
    *,
    seed: int,
    split: int,
    number: int,
) -> Scan:
    """Put a shape on a floor, with clutter around it, and scan it from one to three places.

    The form of the shape is that of the shape with the same seed, split and number in
    ``sampled_shape``. Points are drawn from all rays that met something; a share of them is
    replaced by outliers: half of these are between the two surfaces at an edge, where a beam meets
    both, and half are anywhere above the floor.

    Args:
        class_name: of the shape.
        n_points: number of points.
        outliers: the largest share of outliers; each scan draws its own share below it.
        noise: standard deviation of the range, relative to the longest side of the shape.
        seed: of the data set.
        split: 0 for training, 1 for test.
        number: of the scan among those of its class in the split.
    """
    form, _, rest = random_streams(class_name, seed, split, number, streams=3)
    rng = np.random.default_rng(rest)
    mesh, angle = built(class_name, form)
    mesh.vertices = mesh.vertices @ rotation_about_y(angle)
    scene = _scene(mesh, rng)
    number_of_views = rng.integers(1, MOST_VIEWS + 1)
    cameras = [_camera(rng) for _ in range(number_of_views)]
    flying = round(n_points * rng.uniform(0, outliers))
    side = 8 + int(2 * np.sqrt(n_points))
    while True:
        views = [_view(scene, camera, side, noise, rng) for camera in cameras]
        surfaces = _joined([view.surfaces for view in views])
        if len(surfaces.points) >= n_points:
            break
        side *= 2
    on_surfaces = n_points - flying
    kept = rng.choice(len(surfaces.points), on_surfaces, replace=False)
    edges = _joined([view.edges for view in views])
    at_edges = min(flying // 2, len(edges.points))
    drawn = rng.choice(len(edges.points), at_edges, replace=False)
    stray = _stray(flying - at_edges, rng)
    parts = [surfaces.take(kept), edges.take(drawn), stray]
    scan = _joined(parts)
    return scan.take(rng.permutation(n_points))


def _scene(mesh: Trimesh, rng: Generator) -> Scene:
    """Return a shape of longest side 1 on a floor, with clutter that does not touch it."""
    low, high = mesh.bounds
    size = (high - low).max()
    middle = (low + high) / 2
    middle[1] = low[1]
    offset = rng.uniform(-MOST_OFFSET, MOST_OFFSET, 3) * (1, 0, 1)
    mesh.vertices = (mesh.vertices - middle) / size + offset
    from_offset = mesh.vertices - offset
    reach = np.linalg.norm(from_offset[:, [0, 2]], axis=1).max()
    names = parts_of_faces(mesh)
    parts = [np.where(names == "", OBJECT, names)]
    corners = [mesh.triangles]
    albedos = [_one_albedo(mesh, rng)]
    for _ in range(rng.integers(1, MOST_CLUTTER + 1)):
        thing = _thing(rng, offset, reach)
        if thing is None:
            continue
        corners.append(thing.triangles)
        parts.append(np.full(len(thing.faces), CLUTTER))
        albedos.append(_one_albedo(thing, rng))
    floor = turned(((0, 0), (FLOOR_RADIUS, 0)))
    corners.append(floor.triangles)
    parts.append(np.full(len(floor.faces), FLOOR))
    albedos.append(_one_albedo(floor, rng))
    return Scene(
        corners=np.concatenate(corners),
        parts=np.concatenate(parts),
        albedos=np.concatenate(albedos),
    )


def _one_albedo(mesh: Trimesh, rng: Generator) -> Array:
    """Return an albedo that all faces of a mesh share."""
    return np.full(len(mesh.faces), rng.uniform(0.3, 1.0))


def _thing(rng: Generator, offset: Array, reach: float) -> Trimesh | None:
    """Return a box, a drum or a leaning bar on the floor, or None where the object leaves no room.

    Args:
        rng: random generator.
        offset: ``(3,)`` the middle of the object.
        reach: its radius around the vertical.
    """
    half = rng.uniform(0.04, 0.16)
    height = rng.uniform(0.05, 0.45)
    kind = rng.integers(3)
    width = 1.5 * half
    for _ in range(TRIES):
        angle = rng.uniform(0, 2 * np.pi)
        distance = (FLOOR_RADIUS - width) * np.sqrt(rng.random())
        direction = np.array((np.cos(angle), 0, np.sin(angle)))
        place = distance * direction
        if np.linalg.norm(place - offset) > reach + width:
            break
    else:
        return None
    if kind == 0:
        depth = half * rng.uniform(0.5, 2.0)
        thing = box(around(2 * half), (0.0, height), around(depth))
    elif kind == 1:
        thing = disc(half, (0.0, height))
    else:
        thing = rod((-half, 0.02, 0), (half, height, 0), 0.02)  # leans
    thing.vertices = thing.vertices @ rotation_about_y(angle) + place
    return thing


def _camera(rng: Generator) -> Camera:
    """Return a scanner outside the floor that looks at its middle."""
    angle = rng.uniform(0, 2 * np.pi)
    distance = rng.uniform(2.0, 3.0)
    height = rng.uniform(0.5, 1.5)
    x = distance * np.cos(angle)
    z = distance * np.sin(angle)
    place = np.array((x, height, z))
    target = np.array((0.0, 0.2, 0.0))
    return Camera.looking_at(target, place)


class View(NamedTuple):
    """What is seen from one place: points on surfaces, and points at edges."""

    surfaces: Scan
    edges: Scan


def _view(scene: Scene, camera: Camera, side: int, noise: float, rng: Generator) -> View:
    """Scan a scene from one place with ``side`` times ``side`` rays."""
    triangles = camera.seen(scene.corners)
    shift = rng.random(2)
    grid = RayGrid.around(triangles.reshape(-1, 3), side, shift)
    depths, faces = nearest_faces(triangles, grid)
    lengths = np.linalg.norm(grid.directions, axis=1)
    units = grid.directions / lengths[:, None]
    first_sides = triangles[:, 1] - triangles[:, 0]
    second_sides = triangles[:, 2] - triangles[:, 0]
    normals = np.cross(first_sides, second_sides)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-12)

    rays = np.flatnonzero(faces != NOTHING)
    face = faces[rays]
    unit = units[rays]
    range_noise = noise * rng.standard_normal(len(rays))
    ranges = depths[rays] * lengths[rays] + range_noise
    facing = np.abs(np.einsum("rc,rc->r", normals[face], unit))
    intensity_noise = INTENSITY_NOISE * rng.standard_normal(len(rays))
    shades = scene.albedos[face] * facing + intensity_noise
    points = camera.world(unit * ranges[:, None])
    surfaces = Scan(points, scene.parts[face], shades.clip(0, 1))

    across = depths.reshape(side, side)
    next_to = np.roll(across, -1, axis=1)
    next_to[:, -1] = np.inf
    step = np.full_like(across, np.inf)
    both = np.isfinite(across) & np.isfinite(next_to)
    np.subtract(next_to, across, out=step, where=both)
    is_edge = both & (np.abs(step) > STEP)
    at_edge = np.flatnonzero(is_edge)
    share = rng.uniform(0.1, 0.9, len(at_edge))
    between = depths[at_edge] + share * step.ravel()[at_edge]
    edge_points = camera.world(grid.directions[at_edge] * between[:, None])
    edge_albedos = scene.albedos[faces[at_edge]]
    edges = Scan(
        edge_points,
        np.full(len(at_edge), OUTLIER),
        edge_albedos * rng.uniform(0, 1, len(at_edge)),
    )
    return View(surfaces, edges)


def _stray(number: int, rng: Generator) -> Scan:
    """Return points anywhere above the floor, of dust and of reflections."""
    angle = rng.uniform(0, 2 * np.pi, number)
    radius = FLOOR_RADIUS * np.sqrt(rng.random(number))
    height = rng.uniform(0, STRAY_HEIGHT, number)
    x = radius * np.cos(angle)
    z = radius * np.sin(angle)
    points = np.column_stack((x, height, z))
    intensities = rng.uniform(0, 0.5, number)
    return Scan(points, np.full(number, OUTLIER), intensities)


def _joined(scans: Sequence[Scan]) -> Scan:
    """Return all points of several scans."""
    points = [scan.points for scan in scans]
    parts = [scan.parts for scan in scans]
    intensities = [scan.intensities for scan in scans]
    return Scan(np.concatenate(points), np.concatenate(parts), np.concatenate(intensities))
