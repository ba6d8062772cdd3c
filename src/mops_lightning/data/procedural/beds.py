"""Bed builder."""

import numpy as np
from numpy.random import Generator
from trimesh import Trimesh

from mops_lightning.data.procedural.mesh_parts import Span, around, box, cushion, join, rod


def bed(rng: Generator) -> Trimesh:
    """Return a bed with mattress, pillows and headboard, possibly a footboard or four posts."""
    width, length = rng.uniform(0.8, 1.7), rng.uniform(1.7, 2.1)
    foot, frame = rng.uniform(0.08, 0.3), rng.uniform(0.12, 0.22)
    top = foot + frame + rng.uniform(0.14, 0.28)
    head = top + rng.uniform(0.2, 0.7)
    z = around(length)
    # Rails instead of a box, and no mattress under the blanket: hidden surfaces get no points.
    parts = [box(around(width), (foot, foot + frame), around(0.06, at)) for at in z]
    parts += [box(around(0.06, x), (foot, foot + frame), z) for x in around(width - 0.06)]
    fold = z[1] - (length * rng.uniform(0.3, 0.6) if rng.random() < 0.5 else 0.0)
    mattress = (z[0] + 0.03, fold - 0.03)
    parts.append(cushion(around(width * 0.96), (foot + frame * 0.8, top), mattress, 0.08))
    if fold < z[1]:
        blanket = (foot + frame * 0.6, top + 0.04)
        parts.append(cushion(around(width * 1.03), blanket, (fold - 0.05, z[1] + 0.02), 0.06))
    for x in (-width / 2 + 0.06, width / 2 - 0.06):
        parts += [rod((x, 0, at), (x, foot + 0.02, at), 0.05, 4) for at in (z[0] + 0.1, z[1] - 0.1)]
    double = width > 1.15
    wide = width * 0.42 if double else min(0.62, width * 0.8)
    for x in (-width / 4, width / 4) if double else (0.0,):
        pillow = around(0.38, z[0] + 0.3)
        parts.append(cushion(around(wide, x), (top - 0.03, top + 0.11), pillow, 0.1))
    parts += _board(rng, width, (0.0, head), z[0] - 0.03)
    if rng.random() < 0.45:
        parts += _board(rng, width, (0.0, top + rng.uniform(0.0, 0.25)), z[1] + 0.05)
    elif rng.random() < 0.3:
        tall = top + rng.uniform(0.8, 1.1)
        posts = [(x, at) for at in z for x in around(width)]
        parts += [rod((x, 0, at), (x, tall, at), 0.045, 8) for x, at in posts]
        for start, end in ((0, 1), (1, 3), (3, 2), (2, 0)):
            (x0, z0), (x1, z1) = posts[start], posts[end]
            parts.append(rod((x0, tall, z0), (x1, tall, z1), 0.035, 8))
    return join(parts)


def _board(rng: Generator, width: float, y: Span, z: float) -> list[Trimesh]:
    """Return a headboard or footboard: a panel, or posts with a rail and slats."""
    low, high = y
    if rng.random() < 0.6:
        return [box(around(width * 1.03), (low + 0.1, high), around(0.07, z))]
    parts = [rod((x, low, z), (x, high, z), 0.045, 8) for x in around(width)]
    parts.append(box(around(width), (high - 0.14, high - 0.04), around(0.05, z)))
    for x in np.linspace(-width / 2, width / 2, rng.integers(7, 11))[1:-1]:
        parts.append(rod((x, low + 0.2, z), (x, high - 0.1, z), 0.02, 6))
    return parts
