"""Builder of beds."""

import numpy as np
from numpy.random import Generator
from trimesh import Trimesh

from mops_lightning.data.procedural.mesh_parts import (
    Span,
    around,
    box,
    cushion,
    join,
    named,
    post,
    rod,
)


def bed(rng: Generator) -> Trimesh:
    """Return a bed with mattress, pillows and headboard, possibly a footboard or four posts."""
    width = rng.uniform(0.8, 1.7)
    length = rng.uniform(1.7, 2.1)
    foot = rng.uniform(0.08, 0.3)
    frame = rng.uniform(0.12, 0.22)
    top = foot + frame + rng.uniform(0.14, 0.28)
    head = top + rng.uniform(0.2, 0.7)
    z = around(length)
    head_end, foot_end = z
    y_frame = (foot, foot + frame)
    parts = named("frame", *_rails(width, y_frame, z))
    parts += named("mattress", *_mattress(rng, width, z, foot, frame, top))
    parts += named("leg", *_bed_legs(width, z, foot))
    parts += named("pillow", *_pillows(width, top, head_end + 0.3))
    headboard = _board(rng, width, (0.0, head), head_end - 0.03)
    parts += named("board", *headboard)
    if rng.random() < 0.45:
        low = (0.0, top + rng.uniform(0.0, 0.25))
        footboard = _board(rng, width, low, foot_end + 0.05)
        parts += named("board", *footboard)
    elif rng.random() < 0.3:
        tall = top + rng.uniform(0.8, 1.1)
        parts += named("frame", *_four_posts(width, z, tall))
    return join(parts)


# Rails instead of a box, and no mattress under the blanket: hidden surfaces get no points.
def _rails(width: float, y: Span, z: Span) -> list[Trimesh]:
    parts = [box(around(width), y, around(0.06, at)) for at in z]
    for x in around(width - 0.06):
        parts.append(box(around(0.06, x), y, z))
    return parts


def _mattress(
    rng: Generator,
    width: float,
    z: Span,
    foot: float,
    frame: float,
    top: float,
) -> list[Trimesh]:
    """Return a mattress, and a blanket over a part of it if there is one."""
    start, end = z
    length = end - start
    fold = end
    has_blanket = rng.random() < 0.5
    if has_blanket:
        fold = end - length * rng.uniform(0.3, 0.6)
    under = foot + frame * 0.8
    uncovered = (start + 0.03, fold - 0.03)
    parts = [cushion(around(width * 0.96), (under, top), uncovered, 0.08)]
    if has_blanket:
        y = (foot + frame * 0.6, top + 0.04)
        covered = (fold - 0.05, end + 0.02)
        parts.append(cushion(around(width * 1.03), y, covered, 0.06))
    return parts


def _bed_legs(width: float, z: Span, foot: float) -> list[Trimesh]:
    parts = []
    head_end, foot_end = z
    for x in (-width / 2 + 0.06, width / 2 - 0.06):
        for at in (head_end + 0.1, foot_end - 0.1):
            parts.append(post(x, at, foot + 0.02, 0.05, 4))
    return parts


def _pillows(width: float, top: float, z: float) -> list[Trimesh]:
    is_double = width > 1.15
    if is_double:
        wide = width * 0.42
        centres = [-width / 4, width / 4]
    else:
        wide = min(0.62, width * 0.8)
        centres = [0.0]
    y = (top - 0.03, top + 0.11)
    depth = around(0.38, z)
    return [cushion(around(wide, x), y, depth, 0.1) for x in centres]


def _four_posts(width: float, z: Span, height: float) -> list[Trimesh]:
    """Return the posts and the upper bars of a four-poster bed."""
    left, right = around(width)
    head, foot = z
    corners = [
        (left, head),
        (right, head),
        (left, foot),
        (right, foot),
    ]
    parts = [post(x, at, height, 0.045, 8) for x, at in corners]
    sides = (
        (0, 1),
        (1, 3),
        (3, 2),
        (2, 0),
    )
    for start, end in sides:
        x0, z0 = corners[start]
        x1, z1 = corners[end]
        parts.append(rod((x0, height, z0), (x1, height, z1), 0.035, 8))
    return parts


def _board(rng: Generator, width: float, y: Span, z: float) -> list[Trimesh]:
    """Return a headboard or footboard: a panel, or posts with a rail and slats."""
    low, high = y
    is_panel = rng.random() < 0.6
    if is_panel:
        panel = box(around(width * 1.03), (low + 0.1, high), around(0.07, z))
        return [panel]
    parts = [rod((x, low, z), (x, high, z), 0.045, 8) for x in around(width)]
    rail = (high - 0.14, high - 0.04)
    parts.append(box(around(width), rail, around(0.05, z)))
    slats = np.linspace(-width / 2, width / 2, rng.integers(7, 11))
    for x in slats[1:-1]:
        bottom = (x, low + 0.2, z)
        top = (x, high - 0.1, z)
        parts.append(rod(bottom, top, 0.02, 6))
    return parts
