"""Rays from a place to triangles: what a scanner sees of a scene."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

NOTHING = -1
"""The face of a ray that hits none."""

MOST_PAIRS = 4_000_000
"""Rays times triangles that are compared at once, so that memory stays bounded."""


class Camera(NamedTuple):
    """A place and a direction of view.

    Attributes:
        place: ``(3,)``.
        axes: ``(3, 3)``, the directions to the right, up and forward as rows.
    """

    place: Array
    axes: Array

    @classmethod
    def looking_at(cls, target: Array, place: Array) -> "Camera":
        """Return a camera that looks from a place to a target, which is not straight above it."""
        forward = target - place
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, (0.0, 1.0, 0.0))
        right /= np.linalg.norm(right)
        up = np.cross(right, forward)
        return cls(place, np.stack((right, up, forward)))

    def seen(self, points: Array) -> Array:
        """Return points ``(..., 3)`` in the axes of the camera; the third is the depth."""
        return (points - self.place) @ self.axes.T

    def world(self, seen: Array) -> Array:
        """Return the places of points ``(..., 3)`` that are given in the axes of the camera."""
        return self.place + seen @ self.axes


class RayGrid(NamedTuple):
    """Rays through a regular grid of a camera's image plane, at depth 1.

    Attributes:
        across: ``(W,)`` positions to the right.
        up: ``(H,)`` positions upwards.
    """

    across: Array
    up: Array

    @classmethod
    def around(cls, seen: Array, side: int, shift: Array) -> "RayGrid":
        """Return ``side`` times ``side`` rays that cover points.

        Args:
            seen: ``(P, 3)`` in the axes of the camera, in front of it.
            side: number of rays along each axis.
            shift: ``(2,)`` of the grid, in spacings between 0 and 1.
        """
        depths = seen[:, 2:]
        image = seen[:, :2] / depths
        low = image.min(0)
        spacing = (image.max(0) - low) / side
        positions = np.arange(side)[:, None] + shift
        steps = low + positions * spacing
        return cls(steps[:, 0], steps[:, 1])

    @property
    def directions(self) -> Array:
        """The directions ``(H · W, 3)`` of the rays, row by row, in the axes of the camera.

        Their depth is 1.
        """
        across, up = np.meshgrid(self.across, self.up)
        ones = np.ones_like(across)
        directions = np.stack((across, up, ones), axis=-1)
        return directions.reshape(-1, 3)


def nearest_faces(triangles: Array, grid: RayGrid) -> tuple[Array, Rows]:
    """Return where every ray of a grid first meets a triangle.

    A triangle is compared with the rays in the rectangle around its image alone.

    Args:
        triangles: ``(F, 3, 3)`` corners in the axes of the camera, all in front of it.
        grid: the rays.

    Returns:
        The depths ``(H · W,)``, infinite for rays that meet nothing, and the rows of the faces,
        ``NOTHING`` for these.
    """
    image = triangles[..., :2] / triangles[..., 2:]
    low = image.min(1)
    high = image.max(1)
    first_column = np.searchsorted(grid.across, low[:, 0])
    last_column = np.searchsorted(grid.across, high[:, 0], side="right")
    columns = last_column - first_column
    first_row = np.searchsorted(grid.up, low[:, 1])
    last_row = np.searchsorted(grid.up, high[:, 1], side="right")
    rows = last_row - first_row
    pairs = columns * rows

    width = len(grid.across)
    depths = np.full(width * len(grid.up), np.inf)
    faces = np.full(len(depths), NOTHING)
    directions = grid.directions
    for group in _groups(pairs):
        pairs_of_group = pairs[group]
        face = np.repeat(group, pairs_of_group)
        ends = np.cumsum(pairs_of_group)
        starts = np.repeat(ends - pairs_of_group, pairs_of_group)
        place = np.arange(len(face)) - starts
        row = first_row[face] + place // columns[face]
        column = first_column[face] + place % columns[face]
        ray = row * width + column
        depth = _depths(triangles[face], directions[ray])
        _keep_nearest(depths, faces, ray, depth, face)
    return depths, faces


def _groups(pairs: Rows) -> list[Rows]:
    """Split the triangles that have rays into groups of about ``MOST_PAIRS`` comparisons."""
    compared = np.flatnonzero(pairs)
    number = np.cumsum(pairs[compared]) // MOST_PAIRS
    is_new = np.diff(number)
    return np.split(compared, np.flatnonzero(is_new) + 1)


def _depths(triangles: Array, directions: Array) -> Array:
    """Return the depths at which rays meet triangles, ray i triangle i; infinite for misses.

    A ray meets a triangle if it passes all three edges on the same side.

    Args:
        triangles: ``(P, 3, 3)`` corners.
        directions: ``(P, 3)`` of the rays from the origin, with depth 1.
    """
    first = triangles[:, 0]
    second = triangles[:, 1]
    third = triangles[:, 2]
    edges = (
        (first, second),
        (second, third),
        (third, first),
    )
    sides_of_edges = []
    for start, end in edges:
        normal = np.cross(start, end)
        sides_of_edges.append(np.einsum("pc,pc->p", normal, directions))
    sides = np.stack(sides_of_edges)
    inside = (sides >= 0).all(0) | (sides <= 0).all(0)
    normals = np.cross(second - first, third - first)
    towards = np.einsum("pc,pc->p", normals, directions)
    hit = inside & (towards != 0)
    depths = np.full(len(triangles), np.inf)
    offsets = np.einsum("pc,pc->p", normals, first)
    np.divide(offsets, towards, out=depths, where=hit)
    return depths


def _keep_nearest(depths: Array, faces: Rows, ray: Rows, depth: Array, face: Rows) -> None:
    """Write the nearest new depth of every ray, and its face, where it is nearer than the old."""
    hit = np.flatnonzero(np.isfinite(depth))
    by_ray_and_depth = np.lexsort((depth[hit], ray[hit]))
    order = hit[by_ray_and_depth]
    rays, places = np.unique(ray[order], return_index=True)
    nearest = order[places]
    is_nearer = depth[nearest] < depths[rays]
    nearer_rays = rays[is_nearer]
    nearer = nearest[is_nearer]
    depths[nearer_rays] = depth[nearer]
    faces[nearer_rays] = face[nearer]
