"""Builders of seats: chair, sofa, stool."""

import numpy as np
from numpy.random import Generator
from trimesh import Trimesh

from mops_lightning.data.procedural.mesh_parts import (
    Span,
    around,
    box,
    cushion,
    disc,
    four_legs,
    join,
    named,
    rod,
    rungs,
    tube,
)


def chair(rng: Generator) -> Trimesh:
    """Return a chair with one of four backs, legs or a swivel foot, and possibly arms."""
    width = rng.uniform(0.75, 1.05)
    depth = rng.uniform(0.75, 1.0)
    seat = rng.uniform(0.65, 1.15)
    rise = rng.uniform(0.3, 1.25)
    thick = rng.uniform(0.06, 0.16)
    parts = named("seat", _pad(rng, width, depth, (seat - thick, seat)))
    if rng.random() < 0.25:
        parts += named("leg", *_swivel(rng, seat - thick, min(width, depth) * 0.5))
    else:
        legs, ends = four_legs(
            rng, width, depth, seat - thick, rng.uniform(0.035, 0.06), rng.uniform(0, 0.12)
        )
        parts += named("leg", *legs)
        if rng.random() < 0.4:
            parts += named("leg", *rungs(ends, rng.uniform(0.25, 0.5), 0.025))
    parts += named("back", _chair_back(rng, width, -depth / 2, (seat, seat + rise)))
    if rng.random() < 0.3:
        y = seat + rise * rng.uniform(0.3, 0.6)
        reach = depth * rng.uniform(0.25, 0.45)
        for side in (-1, 1):
            x = side * (width / 2 - 0.03)
            post = rod((x, seat - thick / 2, reach - 0.06), (x, y, reach - 0.06), 0.03, 8)
            parts += named("arm", box(around(0.09, x), around(0.05, y), (-depth / 2, reach)), post)
    return join(parts)


def _pad(rng: Generator, width: float, depth: float, y: Span) -> Trimesh:
    if rng.random() < 0.5:
        return cushion(around(width), y, around(depth), 0.05)
    return box(around(width), y, around(depth))


def _swivel(rng: Generator, height: float, reach: float) -> list[Trimesh]:
    star = rng.integers(4, 6)
    parts = [rod((0, 0.12, 0), (0, height, 0), 0.05)]
    for turn in 2 * np.pi * np.arange(star) / star + np.pi / 2:
        foot = (reach * np.cos(turn), 0.04, reach * np.sin(turn))
        parts.append(rod((0, 0.15, 0), foot, (0.05, 0.03), 6))
    return parts


def _chair_back(rng: Generator, width: float, z: float, y: Span) -> Trimesh:
    """Return a back of posts and rails, slats, rungs or a panel, at ``z`` and tilted back."""
    low, high = y
    post = 0.045
    half = width / 2 - 0.045
    kind = rng.integers(4)
    if kind == 0:
        gap = rng.uniform(0.0, 0.25)
        parts = [cushion(around(width * 0.95), (low + gap, high), around(0.11), 0.05)]
        parts += [rod((x, low - 0.05, 0), (x, low + gap + 0.1, 0), post) for x in (-half, half)]
    else:
        parts = [rod((x, low - 0.05, 0), (x, high, 0), post, 8) for x in (-half, half)]
        parts.append(box((-half, half), (high - 0.16, high), around(0.06)))
    if kind == 1:
        for x in np.linspace(-half, half, rng.integers(5, 8))[1:-1]:
            parts.append(box(around(0.06, x), (low, high - 0.16), around(0.04)))
    elif kind == 2:
        for level in np.linspace(low, high - 0.08, rng.integers(4, 6))[1:-1]:
            parts.append(box((-half, half), around(0.1, level), around(0.04)))
    elif kind == 3:
        parts.append(box((-half, half), (low + (high - low) * 0.2, high - 0.1), around(0.04)))
    back = join(parts)
    lean = rng.uniform(0.0, 0.28)
    back.vertices[:, 2] += z + 0.05 - lean * np.clip(back.vertices[:, 1] - low, 0, None)
    return back


def stool(rng: Generator) -> Trimesh:
    """Return a stool: a round or square seat on three or four legs or one foot."""
    width = rng.uniform(0.6, 1.0)
    height = rng.uniform(0.5, 1.4)
    depth = width * rng.uniform(0.8, 1.0)
    thick = rng.uniform(0.04, 0.2)
    y = (height - thick, height)
    is_round = rng.random() < 0.55
    parts = named("seat", disc(width / 2, y) if is_round else _pad(rng, width, depth, y))
    kind = rng.random()
    if kind < 0.25:
        base = width * rng.uniform(0.4, 0.55)
        pillar = rod((0, 0, 0), (0, height - thick, 0), 0.05)
        parts += named("leg", disc(base, (0, 0.05)), pillar)
        if height > 0.9:
            ring = width * 0.33
            y_ring = height * rng.uniform(0.3, 0.45)
            turn = np.linspace(0, 2 * np.pi, 25)
            path = np.column_stack((np.cos(turn) * ring, np.full(25, y_ring), np.sin(turn) * ring))
            bar = rod((-ring, y_ring, 0), (ring, y_ring, 0), 0.02, 8)
            parts += named("leg", tube(path, 0.025, 8, across=(0, 1, 0)), bar)
        return join(parts)
    splay = rng.uniform(0.03, 0.2)
    radius = rng.uniform(0.03, 0.055)
    inset = 0.75 if is_round else 1.0
    if is_round and kind < 0.6:
        turn = 2 * np.pi * np.arange(3) / 3 + np.pi / 2
        out = np.column_stack((np.cos(turn), np.zeros(3), np.sin(turn)))
        tops = out * width * 0.36 + (0, y[0], 0)
        ends = np.stack((tops, out * (width * 0.36 + splay * y[0])), axis=1)
        legs = [rod(top, foot, (radius, radius * 0.8)) for top, foot in ends]
    else:
        legs, ends = four_legs(rng, width * inset, depth * inset, y[0], radius, splay)
    parts += named("leg", *legs)
    if rng.random() < 0.7:
        parts += named("leg", *rungs(ends, rng.uniform(0.2, 0.45), 0.025))
    return join(parts)


def sofa(rng: Generator) -> Trimesh:
    """Return a sofa with one to three seats, arms and back, sometimes with a long side."""
    seats = int(rng.integers(1, 4))
    arm = rng.uniform(0.1, 0.28)
    width = seats * rng.uniform(0.6, 0.8)
    depth = rng.uniform(0.8, 1.0)
    foot = rng.uniform(0.05, 0.18)
    seat = rng.uniform(0.4, 0.52)
    back = seat + rng.uniform(0.32, 0.6)
    rest = seat + rng.uniform(0.1, 0.28)
    thick = rng.uniform(0.18, 0.28)
    whole = width + 2 * arm
    base = seat - rng.uniform(0.14, 0.2)
    edge = rng.uniform(0.03, 0.09)
    parts = [
        box(around(width), (foot, base), (depth / 2 - 0.1, depth / 2 - 0.03)),
        cushion(around(whole), (foot, back), (-depth / 2, -depth / 2 + thick * 0.5), edge),
    ]
    for side in (-1, 1):
        x = around(arm, side * (width + arm) / 2)
        parts.append(cushion(x, (foot, rest), (-depth / 2 + thick * 0.3, depth / 2), edge))
        for z in (-depth / 2 + 0.1, depth / 2 - 0.1):
            x_foot = side * (whole / 2 - 0.08)
            parts.append(rod((x_foot, 0, z), (x_foot, foot + 0.01, z), 0.035, 8))
    long_side = rng.choice((-1, 1)) if seats > 1 and rng.random() < 0.3 else 0
    each = width / seats
    for i in range(seats):
        x = around(each * 0.97, (i - (seats - 1) / 2) * each)
        stretch = 0.6 if long_side * (i - (seats - 1) / 2) == (seats - 1) / 2 > 0 else 0.0
        front = depth / 2 + stretch
        parts.append(cushion(x, (base, seat), (-depth / 2 + thick * 0.5, front), 0.06))
        behind = (-depth / 2 + thick * 0.45, -depth / 2 + thick)
        parts.append(cushion(x, (seat, back + 0.03), behind, 0.06))
        if stretch:
            parts.append(box(x, (foot, base), (depth / 2, front)))
    return join(parts)
