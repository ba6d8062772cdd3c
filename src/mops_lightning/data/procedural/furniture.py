"""Builders of furniture without seats: bed, desk, lamp, shelf, table."""

from itertools import pairwise, product

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
    y = height
    under = y - thick
    if rng.random() < 0.4:
        top = disc(width / 2, (under, y))
        top.apply_scale((1, 1, depth / width))
        inset = 0.68
    else:
        top = box(around(width), (under, y), around(depth))
        inset = rng.uniform(0.82, 0.98)
    parts = named("top", top)
    legs: list[Trimesh] = []
    kind = rng.random()
    if kind < 0.2:
        foot = min(width, depth) * rng.uniform(0.22, 0.34)
        turned_foot = [(foot, 0), (foot, 0.04), (0.08, 0.14), (0.07, under * 0.5), (0.1, under)]
        legs = [turned([(0, 0), *smooth(turned_foot, 16)])]
    elif kind < 0.35:
        for side in (-1, 1):
            x = side * width * 0.34
            legs.append(box(around(0.07, x), (0.05, under), around(depth * 0.16)))
            legs.append(box(around(0.09, x), (0, 0.06), around(depth * 0.75)))
        legs.append(box(around(width * 0.68), around(0.1, under * 0.4), around(0.05)))
    else:
        radius = rng.uniform(0.035, 0.06)
        legs, ends = four_legs(
            rng, width * inset, depth * inset, under, radius, rng.uniform(0, 0.1)
        )
        if rng.random() < 0.4:
            apron = (under - rng.uniform(0.07, 0.14), under)
            wide = width * inset
            deep = depth * inset
            legs += [box(around(wide - 0.1), apron, around(0.03, z)) for z in around(deep - 0.06)]
            legs += [box(around(0.03, x), apron, around(deep - 0.1)) for x in around(wide - 0.06)]
        if rng.random() < 0.25:
            legs += rungs(ends, rng.uniform(0.12, 0.25), 0.03)
    return join(parts + named("leg", *legs))


def desk(rng: Generator) -> Trimesh:
    """Return a desk with drawer blocks or flat drawers, and possibly a back panel and a hutch."""
    width = rng.uniform(1.2, 1.9)
    height = rng.uniform(0.7, 0.95)
    depth = rng.uniform(0.6, 0.9)
    under = height - rng.uniform(0.03, 0.06)
    parts = [box(around(width), (under, height), around(depth))]
    block = width * rng.uniform(0.22, 0.32)
    kind = rng.random()
    with_drawers = (-1, 1) if kind < 0.35 else (rng.choice((-1, 1)),) if kind < 0.75 else ()
    if not with_drawers:  # flat drawers under the whole top
        low = under - rng.uniform(0.1, 0.16)
        for x in (-width / 4, width / 4):
            front = around(width * 0.46, x)
            parts += _drawers(front, (low, under), around(depth * 0.85), 1)
    for side in (-1, 1):
        outer = side * (width / 2 - 0.03)
        inner = outer - side * block
        if side in with_drawers:
            floor = under * rng.choice((0.08, 0.45))
            feet = [outer, inner]
            rows = int(rng.integers(2, 4))
            parts += _drawers((min(feet), max(feet)), (floor, under), around(depth * 0.9), rows)
        elif rng.random() < 0.5:
            parts.append(box(around(0.04, outer), (0, under), around(depth * 0.9)))
            continue
        else:
            floor = under
            feet = [outer]
        for x, z in product(feet, around(depth * 0.8)):
            parts.append(rod((x, 0, z), (x, floor, z), 0.03, 4))
    if rng.random() < 0.6:
        panel = under * rng.uniform(0.3, 0.75)
        parts.append(box(around(width * 0.94), (panel, under), around(0.02, -depth * 0.42)))
    if rng.random() < 0.35:
        parts += _hutch(rng, width, (height, height + rng.uniform(0.3, 0.6)), -depth / 2)
    return join(parts)


def _drawers(x: Span, y: Span, z: Span, rows: int) -> list[Trimesh]:
    parts = [box(x, y, z)]
    levels = np.linspace(y[0], y[1], rows + 1)
    middle = (x[0] + x[1]) / 2
    for low, high in pairwise(levels):
        parts.append(box((x[0] + 0.02, x[1] - 0.02), (low + 0.02, high - 0.02), around(0.04, z[1])))
        parts.append(box(around(0.12, middle), around(0.025, (low + high) / 2), around(0.1, z[1])))
    return parts


def _hutch(rng: Generator, width: float, y: Span, back: float) -> list[Trimesh]:
    z = (back, back + 0.25)
    parts = [box(around(width), (y[1] - 0.03, y[1]), z)]
    for x in np.linspace(-width / 2 + 0.02, width / 2 - 0.02, rng.integers(2, 5)):
        parts.append(box(around(0.03, x), (y[0], y[1] - 0.03), z))
    return parts


def shelf(rng: Generator) -> Trimesh:
    """Return a shelf with sides and boards, and possibly a back, dividers and books."""
    width = rng.uniform(0.6, 1.6)
    height = rng.uniform(0.65, 1.9)
    depth = rng.uniform(0.25, 0.5)
    board = rng.uniform(0.03, 0.05)
    foot = rng.uniform(0.0, 0.12)
    floors = np.linspace(foot, height - board, rng.integers(3, 7))
    half = width / 2
    z = around(depth)
    parts = [box((-half + board, half - board), (y, y + board), z) for y in floors]
    if rng.random() < 0.8:
        parts += [box(around(board, x), (0, height), z) for x in around(width - board)]
    else:
        posts = [(x, at) for x in around(width - 0.06) for at in around(depth - 0.06)]
        parts += [rod((x, 0, at), (x, height, at), 0.03, 4) for x, at in posts]
    if rng.random() < 0.45:
        parts.append(box(around(width - 2 * board), (foot, height), around(0.01, z[0])))
    bays = np.linspace(-half + board, half - board, 1 + int(rng.integers(1, 3 if width > 1 else 2)))
    parts += [box(around(board * 0.8, x), (foot, height), z) for x in bays[1:-1]]
    for y, above in pairwise(floors):
        for left, right in pairwise(bays):
            if rng.random() < 0.45:
                parts += _books(rng, (left + 0.02, right - 0.02), y + board, above - y - board, z)
    return join(parts)


def _books(rng: Generator, x: Span, y: float, room: float, z: Span) -> list[Trimesh]:
    """Return a row of books in part of a bay, from the left or the right."""
    filled = (x[1] - x[0]) * rng.uniform(0.3, 0.9)
    thick = rng.uniform(0.04, 0.11, max(2, int(filled / 0.09)))
    edges = np.concatenate(([0], np.cumsum(thick))) * filled / thick.sum()
    edges = x[0] + edges if rng.random() < 0.5 else x[1] - filled + edges
    parts = []
    for left, right in pairwise(edges):
        tall = room * rng.uniform(0.55, 0.9)
        deep = (z[1] - z[0]) * rng.uniform(0.6, 0.9)
        parts.append(box((left, right), (y, y + tall), (z[0] + 0.02, z[0] + deep)))
    return parts


def lamp(rng: Generator) -> Trimesh:
    """Return a lamp: on a pole, on a turned foot, with a bent pole, or with a jointed arm."""
    base = rng.uniform(0.14, 0.28)
    foot_profile = [(0, 0), (base, 0), (base, 0.03), (base * 0.3, 0.06), (0, 0.06)]
    parts = named("base", turned(foot_profile))
    kind = rng.random()
    wide = rng.uniform(0.2, 0.36)
    low = rng.uniform(0.3, 0.95)
    deep = rng.uniform(0.2, 0.36)
    narrow = wide * rng.uniform(0.4, 1.0)
    pole = rng.uniform(0.016, 0.03)
    if kind < 0.45:  # pole
        y = rng.uniform(0.65, 1.25)
        parts += named("pole", rod((0, 0.03, 0), (0, y + deep * 0.8, 0), pole, 8))
        shade = [turned([(wide, y), (narrow, y + deep)])]
        bar = y + deep - 0.01
        shade.append(rod((-narrow, bar, 0), (narrow, bar, 0), 0.01, 6))
        bulb = [(0, y + 0.04), (0.05, y + 0.07), (0.06, y + 0.1), (0, y + 0.16)]
        shade.append(turned(bulb, 10))
    elif kind < 0.7:  # turned foot, as of table lamps
        foot = rng.uniform(0.1, 0.22)
        profile = [(base * 0.5, 0.05), (foot, low * 0.4), (0.03, low * 0.9), (0.025, low + deep)]
        parts += named("base", turned(smooth(profile, 18)))
        shade = [turned([(wide, low), (narrow, low + deep)])]
    elif kind < 0.85:  # bent pole
        y = rng.uniform(0.9, 1.3)
        reach = rng.uniform(0.35, 0.6)
        path = [(0, 0.05, 0), (0, y * 0.75, 0), (reach * 0.4, y, 0), (reach, y * 0.85, 0)]
        parts += named("pole", tube(smooth(path, 20), pole, 8, across=(0, 0, 1)))
        cone = turned([(wide * 0.7, y * 0.85 - 0.2), (0.05, y * 0.85 + 0.02)])
        shade = [cone.apply_translation((reach, 0, 0))]
    else:  # jointed arm
        elbow = np.array((-rng.uniform(0.1, 0.35), rng.uniform(0.4, 0.6), 0))
        head = elbow + np.array((rng.uniform(0.4, 0.65), rng.uniform(0.1, 0.4), 0))
        hinge = np.array((0, 0, 0.04))
        arm = [rod((0, 0.05, 0), elbow, pole), rod(elbow, head, pole)]
        parts += named("pole", *arm, rod(elbow - hinge, elbow + hinge, 0.04))
        aim = np.array((rng.uniform(0.1, 0.5), -1.0, 0))
        tip = head + 0.22 * aim / np.linalg.norm(aim)
        shade = [rod(head - (tip - head) * 0.3, tip, (0.05, wide * 0.55), 24)]
    return join(parts + named("shade", *shade))


def bed(rng: Generator) -> Trimesh:
    """Return a bed with mattress, pillows and headboard, possibly a footboard or four posts."""
    width = rng.uniform(0.8, 1.7)
    length = rng.uniform(1.7, 2.1)
    foot = rng.uniform(0.08, 0.3)
    frame = rng.uniform(0.12, 0.22)
    top = foot + frame + rng.uniform(0.14, 0.28)
    head = top + rng.uniform(0.2, 0.7)
    z = around(length)
    # Rails instead of a box, and no mattress under the blanket: hidden surfaces get no points.
    rails = [box(around(width), (foot, foot + frame), around(0.06, at)) for at in z]
    rails += [box(around(0.06, x), (foot, foot + frame), z) for x in around(width - 0.06)]
    parts = named("frame", *rails)
    fold = z[1] - (length * rng.uniform(0.3, 0.6) if rng.random() < 0.5 else 0.0)
    mattress = (z[0] + 0.03, fold - 0.03)
    soft = [cushion(around(width * 0.96), (foot + frame * 0.8, top), mattress, 0.08)]
    if fold < z[1]:
        blanket = (foot + frame * 0.6, top + 0.04)
        soft.append(cushion(around(width * 1.03), blanket, (fold - 0.05, z[1] + 0.02), 0.06))
    parts += named("mattress", *soft)
    for x in (-width / 2 + 0.06, width / 2 - 0.06):
        legs = [rod((x, 0, at), (x, foot + 0.02, at), 0.05, 4) for at in (z[0] + 0.1, z[1] - 0.1)]
        parts += named("leg", *legs)
    double = width > 1.15
    wide = width * 0.42 if double else min(0.62, width * 0.8)
    for x in (-width / 4, width / 4) if double else (0.0,):
        pillow = around(0.38, z[0] + 0.3)
        pillows = cushion(around(wide, x), (top - 0.03, top + 0.11), pillow, 0.1)
        parts += named("pillow", pillows)
    parts += named("board", *_board(rng, width, (0.0, head), z[0] - 0.03))
    if rng.random() < 0.45:
        low = (0.0, top + rng.uniform(0.0, 0.25))
        parts += named("board", *_board(rng, width, low, z[1] + 0.05))
    elif rng.random() < 0.3:
        tall = top + rng.uniform(0.8, 1.1)
        posts = [(x, at) for at in z for x in around(width)]
        bars = [rod((x, 0, at), (x, tall, at), 0.045, 8) for x, at in posts]
        for start, end in ((0, 1), (1, 3), (3, 2), (2, 0)):
            (x0, z0) = posts[start]
            (x1, z1) = posts[end]
            bars.append(rod((x0, tall, z0), (x1, tall, z1), 0.035, 8))
        parts += named("frame", *bars)
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
