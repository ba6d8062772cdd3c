"""Legs of tables and seats, and the bars between them."""

import numpy as np
from numpy.random import Generator
from trimesh import Trimesh

from mops_lightning.data.procedural.mesh_parts import Array, rod


def four_legs(
    rng: Generator, width: float, depth: float, height: float, radius: float, splay: float = 0.0
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
    corners = np.array([(-1, 1), (1, 1), (1, -1), (-1, -1)])
    tops = corners * (width / 2 - radius, depth / 2 - radius)
    feet = tops + corners * splay * height
    ends = np.stack(
        (np.insert(tops, 1, height, axis=1), np.insert(feet, 1, 0.0, axis=1)), axis=1
    ).astype(np.float64)
    return [rod(top, foot, (radius, radius * taper), sections) for top, foot in ends], ends


def rungs(ends: Array, level: float, radius: float, sides: tuple[int, ...]) -> list[Trimesh]:
    """Return bars between neighbouring legs.

    Args:
        ends: from ``four_legs``.
        level: height of the bars relative to the height of the legs.
        radius: half the thickness of a bar.
        sides: indices of legs with a bar to the next leg.
    """
    at = ends[:, 1] + level * (ends[:, 0] - ends[:, 1])
    return [rod(at[i], at[(i + 1) % len(at)], radius, 8) for i in sides]
