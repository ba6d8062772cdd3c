"""Builder of desks."""

from itertools import pairwise

import numpy as np
from numpy.random import Generator
from trimesh import Trimesh

from mops_lightning.data.procedural.mesh_parts import (
    Span,
    around,
    box,
    join,
    post,
)


def desk(rng: Generator) -> Trimesh:
    """Return a desk with drawer blocks or flat drawers, and possibly a back panel and a hutch."""
    width = rng.uniform(1.2, 1.9)
    height = rng.uniform(0.7, 0.95)
    depth = rng.uniform(0.6, 0.9)
    under = height - rng.uniform(0.03, 0.06)
    top = box(around(width), (under, height), around(depth))
    parts = [top]
    block = width * rng.uniform(0.22, 0.32)
    sides_with_drawers = _sides_with_drawers(rng)
    if not sides_with_drawers:
        parts += _flat_drawers(rng, width, depth, under)
    for side in (-1, 1):
        outer = side * (width / 2 - 0.03)
        inner = outer - side * block
        if side in sides_with_drawers:
            parts += _drawer_block(rng, outer, inner, depth, under)
        else:
            parts += _desk_support(rng, outer, depth, under)
    if rng.random() < 0.6:
        low = under * rng.uniform(0.3, 0.75)
        rear = around(0.02, -depth * 0.42)
        parts.append(box(around(width * 0.94), (low, under), rear))
    if rng.random() < 0.35:
        hutch_top = height + rng.uniform(0.3, 0.6)
        parts += _hutch(rng, width, (height, hutch_top), -depth / 2)
    return join(parts)


def _sides_with_drawers(rng: Generator) -> tuple[int, ...]:
    """Return the sides of a desk with a block of drawers: -1 for the left, 1 for the right."""
    kind = rng.random()
    if kind < 0.35:
        return (-1, 1)
    if kind < 0.75:
        return (rng.choice((-1, 1)),)
    return ()


def _flat_drawers(rng: Generator, width: float, depth: float, under: float) -> list[Trimesh]:
    """Return two drawers under the whole top."""
    y = (under - rng.uniform(0.1, 0.16), under)
    z = around(depth * 0.85)
    half = width * 0.46
    left = _drawers(around(half, -width / 4), y, z, 1)
    right = _drawers(around(half, width / 4), y, z, 1)
    return left + right


def _drawer_block(
    rng: Generator, outer: float, inner: float, depth: float, under: float
) -> list[Trimesh]:
    """Return drawers above each other between two x, on four feet."""
    floor = under * rng.choice((0.08, 0.45))
    rows = int(rng.integers(2, 4))
    x = (min(outer, inner), max(outer, inner))
    z = around(depth * 0.9)
    parts = _drawers(x, (floor, under), z, rows)
    parts += _feet(outer, depth, floor)
    parts += _feet(inner, depth, floor)
    return parts


def _desk_support(rng: Generator, x: float, depth: float, under: float) -> list[Trimesh]:
    """Return the side of a desk without drawers: a panel or two legs."""
    if rng.random() < 0.5:
        side = box(around(0.04, x), (0, under), around(depth * 0.9))
        return [side]
    return _feet(x, depth, under)


def _feet(x: float, depth: float, height: float) -> list[Trimesh]:
    places = around(depth * 0.8)
    return [post(x, z, height, 0.03, 4) for z in places]


def _drawers(x: Span, y: Span, z: Span, rows: int) -> list[Trimesh]:
    left, right = x
    bottom, top = y
    front = z[1]
    middle = (left + right) / 2
    parts = [box(x, y, z)]
    levels = np.linspace(bottom, top, rows + 1)
    for low, high in pairwise(levels):
        level = (low + high) / 2
        y_face = (low + 0.02, high - 0.02)
        face = box((left + 0.02, right - 0.02), y_face, around(0.04, front))
        knob = box(around(0.12, middle), around(0.025, level), around(0.1, front))
        parts += [face, knob]
    return parts


def _hutch(rng: Generator, width: float, y: Span, back: float) -> list[Trimesh]:
    bottom, top = y
    z = (back, back + 0.25)
    shelf = box(around(width), (top - 0.03, top), z)
    parts = [shelf]
    end = width / 2 - 0.02
    y_wall = (bottom, top - 0.03)
    for x in np.linspace(-end, end, rng.integers(2, 5)):
        parts.append(box(around(0.03, x), y_wall, z))
    return parts
