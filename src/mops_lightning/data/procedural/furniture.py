"""Builders of tables, lamps and shelves."""

from itertools import pairwise

import numpy as np
from numpy.random import Generator
from trimesh import Trimesh

from mops_lightning.data.procedural.mesh_parts import (
    Span,
    around,
    box,
    disc,
    four_legs,
    join,
    named,
    post,
    rod,
    rungs,
    smooth,
    tube,
    turned,
)


def table(rng: Generator) -> Trimesh:
    """Return a table: a round, oval or rectangular top on legs, a pillar or two trestles."""
    width = rng.uniform(0.6, 1.9)
    height = rng.uniform(0.5, 1.1)
    depth = width * rng.uniform(0.5, 1.0)
    thick = rng.uniform(0.03, 0.1)
    under = height - thick
    if rng.random() < 0.4:
        top = disc(width / 2, (under, height))
        top.apply_scale((1, 1, depth / width))
        inset = 0.68
    else:
        top = box(around(width), (under, height), around(depth))
        inset = rng.uniform(0.82, 0.98)
    kind = rng.random()
    if kind < 0.2:
        foot_width = min(width, depth)
        legs = [_pillar(rng, foot_width, under)]
    elif kind < 0.35:
        legs = _trestles(width, depth, under)
    else:
        legs = _table_legs(rng, width * inset, depth * inset, under)
    return join(named("top", top) + named("leg", *legs))


def _pillar(rng: Generator, width: float, height: float) -> Trimesh:
    foot = width * rng.uniform(0.22, 0.34)
    profile = [
        (foot, 0),
        (foot, 0.04),
        (0.08, 0.14),
        (0.07, height * 0.5),
        (0.1, height),
    ]
    return turned([(0, 0), *smooth(profile, 16)])


def _trestles(width: float, depth: float, height: float) -> list[Trimesh]:
    parts = []
    for side in (-1, 1):
        x = side * width * 0.34
        post = box(around(0.07, x), (0.05, height), around(depth * 0.16))
        foot = box(around(0.09, x), (0, 0.06), around(depth * 0.75))
        parts += [post, foot]
    level = around(0.1, height * 0.4)
    bar = box(around(width * 0.68), level, around(0.05))
    return [*parts, bar]


def _table_legs(rng: Generator, width: float, depth: float, height: float) -> list[Trimesh]:
    """Return four legs, possibly with an apron under the top and with rungs."""
    radius = rng.uniform(0.035, 0.06)
    splay = rng.uniform(0, 0.1)
    parts, ends = four_legs(rng, width, depth, height, radius, splay)
    if rng.random() < 0.4:
        apron = (height - rng.uniform(0.07, 0.14), height)
        along_x = around(width - 0.1)
        along_z = around(depth - 0.1)
        for z in around(depth - 0.06):
            parts.append(box(along_x, apron, around(0.03, z)))
        for x in around(width - 0.06):
            parts.append(box(around(0.03, x), apron, along_z))
    if rng.random() < 0.25:
        level = rng.uniform(0.12, 0.25)
        parts += rungs(ends, level, 0.03)
    return parts


def lamp(rng: Generator) -> Trimesh:
    """Return a lamp: on a pole, on a turned foot, with a bent pole, or with a jointed arm."""
    base = rng.uniform(0.14, 0.28)
    foot_profile = [
        (0, 0),
        (base, 0),
        (base, 0.03),
        (base * 0.3, 0.06),
        (0, 0.06),
    ]
    foot = named("base", turned(foot_profile))
    kind = rng.random()
    wide = rng.uniform(0.2, 0.36)
    low = rng.uniform(0.3, 0.95)
    deep = rng.uniform(0.2, 0.36)
    narrow = wide * rng.uniform(0.4, 1.0)
    pole = rng.uniform(0.016, 0.03)
    if kind < 0.45:
        parts = _pole_lamp(rng, wide, narrow, deep, pole)
    elif kind < 0.7:
        parts = _table_lamp(rng, base, low, wide, narrow, deep)
    elif kind < 0.85:
        parts = _bent_lamp(rng, wide, pole)
    else:
        parts = _jointed_lamp(rng, wide, pole)
    return join(foot + parts)


def _pole_lamp(
    rng: Generator, wide: float, narrow: float, deep: float, pole: float
) -> list[Trimesh]:
    y = rng.uniform(0.65, 1.25)
    top = y + deep
    stem = rod((0, 0.03, 0), (0, y + deep * 0.8, 0), pole, 8)
    shade = turned([(wide, y), (narrow, top)])
    level = top - 0.01
    bar = rod((-narrow, level, 0), (narrow, level, 0), 0.01, 6)
    bulb = [
        (0, y + 0.04),
        (0.05, y + 0.07),
        (0.06, y + 0.1),
        (0, y + 0.16),
    ]
    glass = turned(bulb, 10)
    return named("pole", stem) + named("shade", shade, bar, glass)


def _table_lamp(
    rng: Generator,
    base: float,
    low: float,
    wide: float,
    narrow: float,
    deep: float,
) -> list[Trimesh]:
    """Return a turned foot, as of table lamps, and a shade from the height ``low``."""
    foot = rng.uniform(0.1, 0.22)
    profile = [
        (base * 0.5, 0.05),
        (foot, low * 0.4),
        (0.03, low * 0.9),
        (0.025, low + deep),
    ]
    shade = turned([(wide, low), (narrow, low + deep)])
    body = turned(smooth(profile, 18))
    return named("base", body) + named("shade", shade)


def _bent_lamp(rng: Generator, wide: float, pole: float) -> list[Trimesh]:
    y = rng.uniform(0.9, 1.3)
    reach = rng.uniform(0.35, 0.6)
    path = [
        (0, 0.05, 0),
        (0, y * 0.75, 0),
        (reach * 0.4, y, 0),
        (reach, y * 0.85, 0),
    ]
    stem = tube(smooth(path, 20), pole, 8, across=(0, 0, 1))
    level = y * 0.85
    shade = turned([(wide * 0.7, level - 0.2), (0.05, level + 0.02)])
    shade.apply_translation((reach, 0, 0))
    return named("pole", stem) + named("shade", shade)


def _jointed_lamp(rng: Generator, wide: float, pole: float) -> list[Trimesh]:
    elbow_x = -rng.uniform(0.1, 0.35)
    elbow_y = rng.uniform(0.4, 0.6)
    elbow = np.array((elbow_x, elbow_y, 0))
    forearm_x = rng.uniform(0.4, 0.65)
    forearm_y = rng.uniform(0.1, 0.4)
    head = elbow + np.array((forearm_x, forearm_y, 0))
    hinge = np.array((0, 0, 0.04))
    lower_arm = rod((0, 0.05, 0), elbow, pole)
    upper_arm = rod(elbow, head, pole)
    joint = rod(elbow - hinge, elbow + hinge, 0.04)
    aim = np.array((rng.uniform(0.1, 0.5), -1.0, 0))
    tip = head + 0.22 * aim / np.linalg.norm(aim)
    back = head - (tip - head) * 0.3
    shade = rod(back, tip, (0.05, wide * 0.55), 24)
    return named("pole", lower_arm, upper_arm, joint) + named("shade", shade)


def shelf(rng: Generator) -> Trimesh:
    """Return a shelf with sides and boards, and possibly a back, dividers and books."""
    width = rng.uniform(0.6, 1.6)
    height = rng.uniform(0.65, 1.9)
    depth = rng.uniform(0.25, 0.5)
    board = rng.uniform(0.03, 0.05)
    foot = rng.uniform(0.0, 0.12)
    floors = np.linspace(foot, height - board, rng.integers(3, 7))
    inside = width / 2 - board
    z = around(depth)
    x_inside = (-inside, inside)
    parts = [box(x_inside, (y, y + board), z) for y in floors]
    has_sides = rng.random() < 0.8
    if has_sides:
        for x in around(width - board):
            parts.append(box(around(board, x), (0, height), z))
    else:
        parts += _shelf_posts(width, height, depth)
    has_back = rng.random() < 0.45
    if has_back:
        rear = around(0.01, z[0])
        parts.append(box(around(width - 2 * board), (foot, height), rear))
    most_bays = 1
    if width > 1:
        most_bays = 2
    number_of_bays = int(rng.integers(1, most_bays + 1))
    bays = np.linspace(-inside, inside, 1 + number_of_bays)
    for x in bays[1:-1]:
        parts.append(box(around(board * 0.8, x), (foot, height), z))
    for y, above in pairwise(floors):
        room = above - y - board
        for left, right in pairwise(bays):
            if rng.random() < 0.45:
                x_books = (left + 0.02, right - 0.02)
                parts += _books(rng, x_books, y + board, room, z)
    return join(parts)


def _shelf_posts(width: float, height: float, depth: float) -> list[Trimesh]:
    """Return posts at the corners of a shelf."""
    parts = []
    for x in around(width - 0.06):
        for z in around(depth - 0.06):
            parts.append(post(x, z, height, 0.03, 4))
    return parts


def _books(rng: Generator, x: Span, y: float, room: float, z: Span) -> list[Trimesh]:
    """Return a row of books in part of a bay, from the left or the right."""
    start, end = x
    back, front = z
    filled = (end - start) * rng.uniform(0.3, 0.9)
    number = max(2, int(filled / 0.09))
    thick = rng.uniform(0.04, 0.11, number)
    ends = np.concatenate(([0], np.cumsum(thick)))
    edges = ends * filled / thick.sum()
    is_left = rng.random() < 0.5
    if is_left:
        edges = start + edges
    else:
        edges = end - filled + edges
    parts = []
    for left, right in pairwise(edges):
        tall = room * rng.uniform(0.55, 0.9)
        deep = (front - back) * rng.uniform(0.6, 0.9)
        z_book = (back + 0.02, back + deep)
        parts.append(box((left, right), (y, y + tall), z_book))
    return parts
