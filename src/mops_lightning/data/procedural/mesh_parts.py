"""Parts of procedural shapes: boxes, cushions, tubes, surfaces of revolution and legs.

Axes as for the shapes: x to the side, y up, z to the front. Lengths have no unit; clouds are
normalised afterwards. All parts are ``trimesh.Trimesh``.
"""

from collections.abc import Sequence
from functools import cache

import numpy as np
import trimesh
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator
from trimesh import Trimesh

Array = NDArray[np.float64]
Span = tuple[float, float]
"""Lowest and highest coordinate along one axis."""

UPRIGHT = trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0))


def around(width: float, centre: float = 0.0) -> Span:
    """Return the span of a given width around a centre."""
    half = width / 2
    return (centre - half, centre + half)


def box(x: Span, y: Span, z: Span) -> Trimesh:
    """Return the axis-aligned box with three spans."""
    bounds = np.array((x, y, z)).T
    return trimesh.creation.box(bounds=bounds)


def cushion(x: Span, y: Span, z: Span, radius: float) -> Trimesh:
    """Return the box with three spans, slightly domed sides and rounded edges.

    ``radius`` is the radius of the edges, at most half a side.
    """
    ball, faces = _ball()
    low, high = np.array((x, y, z)).T
    centre = (low + high) / 2
    half = (high - low) / 2
    round_off = np.minimum(radius, half)
    corners = np.sign(ball) * (half - round_off)
    vertices = centre + corners + ball * round_off
    return Trimesh(vertices, faces, process=False)


@cache
def _ball() -> tuple[Array, NDArray[np.int64]]:
    """Return vertices and faces of a unit sphere without faces across a coordinate plane.

    Its octants can therefore be moved apart; vertices on a plane stay in the middle of a side.
    """
    angles = np.linspace(-np.pi / 2, np.pi / 2, 9)
    profile = np.column_stack((np.cos(angles), np.sin(angles)))
    ball = trimesh.creation.revolve(profile, sections=16, process=False)
    vertices = np.asarray(ball.vertices).round(12)
    return vertices, np.asarray(ball.faces)


def loft(rings: ArrayLike) -> Trimesh:
    """Return the surface through a series of closed cross-sections, with closed ends.

    Args:
        rings: ``(R, K, 3)``, R cross-sections of K points each.
    """
    stack = np.asarray(rings, dtype=np.float64)
    ends = stack[[0, -1]]
    middles = ends.mean(1, keepdims=True)
    first, last = middles.repeat(stack.shape[1], axis=1)
    stack = np.concatenate((first[None], stack, last[None]))
    rows, sides = stack.shape[:2]
    here = np.arange((rows - 1) * sides)
    ring_start = here // sides * sides
    after = ring_start + (here + 1) % sides
    next_here = here + sides
    next_after = after + sides
    corners = (here, after, next_here, after, next_after, next_here)
    faces = np.stack(corners, axis=1).reshape(-1, 3)
    return Trimesh(stack.reshape(-1, 3), faces, process=False)


def tube(
    path: ArrayLike,
    radii: ArrayLike,
    sections: int = 12,
    across: ArrayLike | None = None,
    flatten: float = 1.0,
) -> Trimesh:
    """Return a closed tube along a path in a plane.

    Args:
        path: ``(R, 3)`` centres of the cross-sections; neighbours must differ.
        radii: one radius, or one per centre.
        sections: corners of a cross-section; 4 makes a square bar.
        across: normal of the path's plane; None for a straight path.
        flatten: ratio of the radius along ``across`` to the radius perpendicular to it.
    """
    centres = np.asarray(path, dtype=np.float64)
    along = np.gradient(centres, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    if across is None:
        start = along[0]
        least = np.abs(start).argmin()
        across = np.cross(start, np.eye(3)[least])
    normal = np.asarray(across, dtype=np.float64)
    normal = normal / np.linalg.norm(normal)
    normal = np.broadcast_to(normal, centres.shape)
    first = normal[:, None] * flatten
    second = np.cross(along, normal)[:, None]

    turn = 2 * np.pi * (np.arange(sections) + 0.5) / sections
    cosines = np.cos(turn)[None, :, None]
    sines = np.sin(turn)[None, :, None]
    ring = cosines * first + sines * second
    # Radius of the inscribed circle, so that bars with few corners are not thinner.
    widths = np.broadcast_to(radii, len(centres))
    reach = widths / np.cos(np.pi / sections)
    rings = centres[:, None] + reach[:, None, None] * ring
    return loft(rings)


def rod(start: ArrayLike, end: ArrayLike, radius: ArrayLike, sections: int = 12) -> Trimesh:
    """Return a straight bar; ``radius`` is one number, or one per end."""
    path = np.stack((np.asarray(start), np.asarray(end)))
    return tube(path, radius, sections)


def post(x: float, z: float, height: float, radius: float, sections: int) -> Trimesh:
    """Return an upright bar that stands on the ground."""
    foot = (x, 0, z)
    top = (x, height, z)
    return rod(foot, top, radius, sections)


def turned(profile: ArrayLike, sections: int = 32) -> Trimesh:
    """Return the surface of revolution about the y axis.

    Args:
        profile: ``(P, 2)`` radius and height, from the bottom up; open at ends off the axis.
        sections: number of steps of the revolution.
    """
    return trimesh.creation.revolve(
        np.asarray(profile), sections=sections, transform=UPRIGHT, process=False
    )


def disc(radius: float, y: Span) -> Trimesh:
    """Return a closed upright cylinder about the y axis."""
    low, high = y
    profile = [
        (0, low),
        (radius, low),
        (radius, high),
        (0, high),
    ]
    return turned(profile)


def smooth(points: ArrayLike, steps: int = 24) -> Array:
    """Return a smooth curve through control points, without overshoot.

    Args:
        points: ``(P, D)``.
        steps: number of points of the result, ``(steps, D)``.
    """
    knots = np.asarray(points, dtype=np.float64)
    places = np.arange(len(knots))
    curve = PchipInterpolator(places, knots)
    samples = np.linspace(0, len(knots) - 1, steps)
    return curve(samples)


def named(part: str, *meshes: Trimesh) -> list[Trimesh]:
    """Return meshes that are one part of a shape, under the name of this part; see ``join``."""
    for mesh in meshes:
        mesh.metadata["part"] = part
    return list(meshes)


def join(parts: Sequence[Trimesh]) -> Trimesh:
    """Return one mesh of all parts; ``metadata["parts"]`` names the part of every face."""
    # trimesh's concatenate also merges normals and visuals, at a third of the time of the dataset.
    faces = []
    names = []
    start = 0
    for part in parts:
        faces.append(part.faces + start)
        name = part.metadata.get("part", "")
        names += [name] * len(part.faces)
        start += len(part.vertices)
    vertices = [part.vertices for part in parts]
    return Trimesh(
        np.concatenate(vertices),
        np.concatenate(faces),
        process=False,
        metadata={"parts": np.array(names)},
    )


def four_legs(
    rng: Generator,
    width: float,
    depth: float,
    height: float,
    radius: float,
    splay: float = 0.0,
) -> tuple[list[Trimesh], Array]:
    """Return four legs, round or square, straight or tapered, and their ends.

    Args:
        rng: chooses the form of the legs.
        width: distance between the outer sides along x at the top.
        depth: distance between the outer sides along z at the top.
        height: y of the top; the feet are at 0.
        radius: half the thickness of a leg at the top.
        splay: horizontal distance from top to foot, relative to the height.

    Returns:
        The legs, and their tops and feet ``(4, 2, 3)``: left front, right front, right back,
        left back.
    """
    sections = int(rng.choice((4, 12)))
    taper = rng.uniform(0.5, 1.0)
    corners = np.array(
        [
            (-1, 1),
            (1, 1),
            (1, -1),
            (-1, -1),
        ]
    )
    tops = corners * (width / 2 - radius, depth / 2 - radius)
    feet = tops + corners * splay * height
    tops = np.insert(tops, 1, height, axis=1)
    feet = np.insert(feet, 1, 0.0, axis=1)
    ends = np.stack((tops, feet), axis=1)
    radii = (radius, radius * taper)
    legs = [rod(top, foot, radii, sections) for top, foot in ends]
    return legs, ends


def rungs(ends: Array, level: float, radius: float) -> list[Trimesh]:
    """Return a bar from every leg to the next one.

    ``ends`` is from ``four_legs``, ``level`` relative to the height of the legs.
    """
    tops = ends[:, 0]
    feet = ends[:, 1]
    places = feet + level * (tops - feet)
    next_places = np.roll(places, -1, axis=0)
    pairs = zip(places, next_places, strict=True)
    return [rod(here, there, radius, 8) for here, there in pairs]
