"""Builders of seats: chair, sofa, stool."""

import numpy as np
from numpy.random import Generator
from trimesh import Trimesh

from mops_lightning.data.procedural.mesh_parts import (
    Array,
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

POST = 0.045
"""Radius of the posts of a chair's back."""


def chair(rng: Generator) -> Trimesh:
    """Return a chair with one of four backs, legs or a swivel foot, and possibly arms."""
    width = rng.uniform(0.75, 1.05)
    depth = rng.uniform(0.75, 1.0)
    seat = rng.uniform(0.65, 1.15)
    rise = rng.uniform(0.3, 1.25)
    thick = rng.uniform(0.06, 0.16)
    under = seat - thick
    rear = -depth / 2
    parts = named("seat", _pad(rng, width, depth, (under, seat)))
    if rng.random() < 0.25:
        reach = min(width, depth) * 0.5
        legs = _swivel(rng, under, reach)
    else:
        legs = _chair_legs(rng, width, depth, under)
    parts += named("leg", *legs)
    back = _chair_back(rng, width, rear, (seat, seat + rise))
    parts += named("back", back)
    if rng.random() < 0.3:
        y = seat + rise * rng.uniform(0.3, 0.6)
        reach = depth * rng.uniform(0.25, 0.45)
        y_span = (seat - thick / 2, y)
        z_span = (rear, reach)
        for side in (-1, 1):
            x = side * (width / 2 - 0.03)
            parts += named("arm", *_chair_arm(x, y_span, z_span))
    return join(parts)


def _chair_legs(rng: Generator, width: float, depth: float, height: float) -> list[Trimesh]:
    radius = rng.uniform(0.035, 0.06)
    splay = rng.uniform(0, 0.12)
    parts, ends = four_legs(rng, width, depth, height, radius, splay)
    if rng.random() < 0.4:
        level = rng.uniform(0.25, 0.5)
        parts += rungs(ends, level, 0.025)
    return parts


def _chair_arm(x: float, y: Span, z: Span) -> list[Trimesh]:
    low, high = y
    front = z[1] - 0.06
    rest = box(around(0.09, x), around(0.05, high), z)
    foot = (x, low, front)
    top = (x, high, front)
    support = rod(foot, top, 0.03, 8)
    return [rest, support]


def _pad(rng: Generator, width: float, depth: float, y: Span) -> Trimesh:
    if rng.random() < 0.5:
        return cushion(around(width), y, around(depth), 0.05)
    return box(around(width), y, around(depth))


def _swivel(rng: Generator, height: float, reach: float) -> list[Trimesh]:
    star = rng.integers(4, 6)
    pillar = rod((0, 0.12, 0), (0, height, 0), 0.05)
    hub = (0, 0.15, 0)
    parts = [pillar]
    turns = 2 * np.pi * np.arange(star) / star + np.pi / 2
    for turn in turns:
        x = reach * np.cos(turn)
        z = reach * np.sin(turn)
        parts.append(rod(hub, (x, 0.04, z), (0.05, 0.03), 6))
    return parts


def _chair_back(rng: Generator, width: float, z: float, y: Span) -> Trimesh:
    """Return a back of posts and rails, slats, rungs or a panel, at ``z`` and tilted back."""
    low, high = y
    half = width / 2 - 0.045
    x = (-half, half)
    kind = rng.integers(4)
    if kind == 0:
        parts = _cushioned_back(rng, width, x, y)
    else:
        parts = _back_frame(x, y)
    if kind == 1:
        parts += _slats(rng, x, y)
    elif kind == 2:
        parts += _rails(rng, x, y)
    elif kind == 3:
        bottom = low + (high - low) * 0.2
        parts.append(box(x, (bottom, high - 0.1), around(0.04)))
    back = join(parts)
    lean = rng.uniform(0.0, 0.28)
    heights = back.vertices[:, 1] - low
    above_seat = np.clip(heights, 0, None)
    back.vertices[:, 2] += z + 0.05 - lean * above_seat
    return back


def _cushioned_back(rng: Generator, width: float, x: Span, y: Span) -> list[Trimesh]:
    low, high = y
    gap = rng.uniform(0.0, 0.25)
    bottom = low + gap
    pad = cushion(around(width * 0.95), (bottom, high), around(0.11), 0.05)
    parts = [pad]
    for side in x:
        foot = (side, low - 0.05, 0)
        top = (side, bottom + 0.1, 0)
        parts.append(rod(foot, top, POST))
    return parts


def _back_frame(x: Span, y: Span) -> list[Trimesh]:
    """Return two posts and the rail between their upper ends."""
    low, high = y
    parts = []
    for side in x:
        foot = (side, low - 0.05, 0)
        top = (side, high, 0)
        parts.append(rod(foot, top, POST, 8))
    rail = box(x, (high - 0.16, high), around(0.06))
    return [*parts, rail]


def _slats(rng: Generator, x: Span, y: Span) -> list[Trimesh]:
    low, high = y
    left, right = x
    places = np.linspace(left, right, rng.integers(5, 8))
    y_slat = (low, high - 0.16)
    return [box(around(0.06, place), y_slat, around(0.04)) for place in places[1:-1]]


def _rails(rng: Generator, x: Span, y: Span) -> list[Trimesh]:
    low, high = y
    levels = np.linspace(low, high - 0.08, rng.integers(4, 6))
    return [box(x, around(0.1, level), around(0.04)) for level in levels[1:-1]]


def stool(rng: Generator) -> Trimesh:
    """Return a stool: a round or square seat on three or four legs or one foot."""
    width = rng.uniform(0.6, 1.0)
    height = rng.uniform(0.5, 1.4)
    depth = width * rng.uniform(0.8, 1.0)
    thick = rng.uniform(0.04, 0.2)
    under = height - thick
    is_round = rng.random() < 0.55
    if is_round:
        seat = disc(width / 2, (under, height))
    else:
        seat = _pad(rng, width, depth, (under, height))
    kind = rng.random()
    if kind < 0.25:
        legs = _stool_foot(rng, width, height, under)
    else:
        splay = rng.uniform(0.03, 0.2)
        radius = rng.uniform(0.03, 0.055)
        if is_round and kind < 0.6:
            legs, ends = _three_legs(width, under, radius, splay)
        else:
            top_width = width
            top_depth = depth
            if is_round:  # legs under the corners of an inscribed square
                top_width *= 0.75
                top_depth *= 0.75
            legs, ends = four_legs(rng, top_width, top_depth, under, radius, splay)
        if rng.random() < 0.7:
            level = rng.uniform(0.2, 0.45)
            legs += rungs(ends, level, 0.025)
    return join(named("seat", seat) + named("leg", *legs))


def _stool_foot(rng: Generator, width: float, height: float, under: float) -> list[Trimesh]:
    """Return a pillar on a disc; of a bar stool, with a ring for the feet."""
    base = width * rng.uniform(0.4, 0.55)
    pillar = rod((0, 0, 0), (0, under, 0), 0.05)
    parts = [disc(base, (0, 0.05)), pillar]
    is_tall = height > 0.9
    if is_tall:
        ring = width * 0.33
        y = height * rng.uniform(0.3, 0.45)
        turn = np.linspace(0, 2 * np.pi, 25)
        x = np.cos(turn) * ring
        z = np.sin(turn) * ring
        path = np.column_stack((x, np.full(25, y), z))
        circle = tube(path, 0.025, 8, across=(0, 1, 0))
        bar = rod((-ring, y, 0), (ring, y, 0), 0.02, 8)
        parts += [circle, bar]
    return parts


def _three_legs(
    width: float, height: float, radius: float, splay: float
) -> tuple[list[Trimesh], Array]:
    """Return three legs under a round seat, and their ends; see ``four_legs``."""
    turn = 2 * np.pi * np.arange(3) / 3 + np.pi / 2
    out = np.column_stack((np.cos(turn), np.zeros(3), np.sin(turn)))
    tops = out * width * 0.36 + (0, height, 0)
    feet = out * (width * 0.36 + splay * height)
    ends = np.stack((tops, feet), axis=1)
    radii = (radius, radius * 0.8)
    legs = [rod(top, foot, radii) for top, foot in ends]
    return legs, ends


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
    rear = -depth / 2
    front = depth / 2
    depth_of_back = (rear, rear + thick * 0.5)
    depth_of_arm = (rear + thick * 0.3, front)
    depth_of_pad = (rear + thick * 0.45, rear + thick)
    parts = [
        box(around(width), (foot, base), (front - 0.1, front - 0.03)),
        cushion(around(whole), (foot, back), depth_of_back, edge),
    ]
    for side in (-1, 1):
        x = around(arm, side * (width + arm) / 2)
        parts.append(cushion(x, (foot, rest), depth_of_arm, edge))
        x_foot = side * (whole / 2 - 0.08)
        for z in (rear + 0.1, front - 0.1):
            ground = (x_foot, 0, z)
            top = (x_foot, foot + 0.01, z)
            parts.append(rod(ground, top, 0.035, 8))
    long_seat = _long_seat(rng, seats)
    each = width / seats
    for number in range(seats):
        from_middle = number - (seats - 1) / 2
        x = around(each * 0.97, from_middle * each)
        end = front
        if number == long_seat:
            end = front + 0.6
        depth_of_seat = (rear + thick * 0.5, end)
        parts.append(cushion(x, (base, seat), depth_of_seat, 0.06))
        parts.append(cushion(x, (seat, back + 0.03), depth_of_pad, 0.06))
        if number == long_seat:
            parts.append(box(x, (foot, base), (front, end)))
    return join(parts)


def _long_seat(rng: Generator, seats: int) -> int | None:
    """Return the number of the seat that is long, the first or the last; None if no seat is."""
    if seats == 1 or rng.random() >= 0.3:
        return None
    side = rng.choice((-1, 1))
    if side == -1:
        return 0
    return seats - 1
