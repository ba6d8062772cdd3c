"""Builders of vessels: bottle, bowl, bucket, cup, goblet, teapot, vase.

Walls are single surfaces, so that no points are on a hidden inner side.
"""

import numpy as np
from numpy.random import Generator
from trimesh import Trimesh

from mops_lightning.data.procedural.mesh_parts import (
    Array,
    disc,
    join,
    named,
    rod,
    smooth,
    tube,
    turned,
)


def bottle(rng: Generator) -> Trimesh:
    """Return a bottle with a straight, waisted or round body and a neck, usually with a cap."""
    radius = rng.uniform(0.22, 0.42)
    height = 1.0
    neck = radius * rng.uniform(0.28, 0.6)
    shoulder = rng.uniform(0.48, 0.68)
    start = shoulder + rng.uniform(0.1, 0.2)
    kind = rng.choice(3, p=(0.5, 0.25, 0.25))
    waist = (1.0, rng.uniform(0.72, 0.88), rng.uniform(1.1, 1.25))[kind]
    body = [
        (radius * 0.9, 0.0),
        (radius, 0.04),
        (radius * waist, shoulder * rng.uniform(0.4, 0.6)),
        (radius, shoulder),
        (neck, start),
        (neck, height),
    ]
    if kind == 0:  # a straight wall, which a smooth curve would round off
        del body[2]
    parts = [turned([(0.0, 0.0), *smooth(body, 28)])]
    if rng.random() < 0.7:
        parts.append(disc(neck * rng.uniform(1.15, 1.5), (height - 0.09, height + 0.03)))
    else:
        parts.append(turned([(neck * 1.25, height - 0.05), (neck * 1.25, height)]))
    return join(parts)


def vase(rng: Generator) -> Trimesh:
    """Return a vase with foot, belly, neck and lip, sometimes with two handles; or a beaker."""
    belly = rng.uniform(0.24, 0.45)
    height = 1.0
    foot = belly * rng.uniform(0.4, 0.7)
    neck = belly * rng.uniform(0.28, 0.85)
    lip = min(neck * rng.uniform(1.05, 1.9), belly * 1.15)
    low = rng.uniform(0.3, 0.55)
    high = rng.uniform(0.72, 0.85)
    if rng.random() < 0.25:  # a beaker: no belly, wider at the top
        wall = smooth([(foot, 0), (foot * rng.uniform(0.9, 1.3), low), (belly, height)], 24)
        return turned([(0.0, 0.0), *wall])
    wall = smooth([(foot, 0), (foot * 0.85, 0.06), (belly, low), (neck, high), (lip, height)], 32)
    parts = [turned([(0.0, 0.0), *wall])]
    if rng.random() < 0.3:
        reach = rng.uniform(0.12, 0.22)
        thick = rng.uniform(0.022, 0.035)
        ends = (high + height) / 2, (low + high) / 2
        parts += [_handle(wall, *ends, side * reach, thick) for side in (-1, 1)]
    return join(parts)


def bowl(rng: Generator) -> Trimesh:
    """Return a bowl on a foot ring; a deep one is similar to a cup without a handle."""
    radius = 0.5
    depth = rng.uniform(0.28, 0.75)
    foot = radius * rng.uniform(0.3, 0.55)
    ring = rng.uniform(0.02, 0.14)
    bulge = rng.uniform(1.5, 3.2)
    up = np.linspace(0, 1, 16)
    wall = foot + (radius - foot) * (1 - (1 - up) ** bulge) ** (1 / 1.3)
    profile = np.column_stack((wall, ring + depth * up))
    parts = [turned([(0.0, ring), *profile]), turned([(foot * 0.95, 0), (foot * 0.95, ring)])]
    if rng.random() < 0.4:
        lip = rng.uniform(0.03, 0.1)
        parts.append(turned([(radius, ring + depth), (radius + lip, ring + depth + lip * 0.3)]))
    return join(parts)


def cup(rng: Generator) -> Trimesh:
    """Return a cup with a handle, sometimes with a saucer."""
    radius = rng.uniform(0.34, 0.5)
    height = rng.uniform(0.55, 1.0)
    foot = radius * rng.uniform(0.55, 1.0)
    waist = rng.uniform(0.85, 1.12)
    middle = (radius + foot) / 2 * waist
    wall = smooth([(foot, 0), (middle, height * 0.45), (radius, height)], 14)
    parts = named("vessel", turned([(0.0, 0.0), *wall]))
    top = height * rng.uniform(0.78, 0.92)
    low = height * rng.uniform(0.15, 0.4)
    handle = _handle(wall, top, low, rng.uniform(0.15, 0.36), rng.uniform(0.025, 0.05))
    parts += named("handle", handle)
    if rng.random() < 0.25:
        plate = radius * rng.uniform(1.5, 1.9)
        parts += named("saucer", turned([(0, -0.03), (plate * 0.6, -0.03), (plate, 0.05)]))
    return join(parts)


def bucket(rng: Generator) -> Trimesh:
    """Return a bucket with a conical wall, a rim and a handle at a random angle."""
    radius = 0.5
    height = rng.uniform(0.75, 1.1)
    foot = radius * rng.uniform(0.6, 0.85)
    parts = [turned([(0, 0), (foot, 0), (radius, height)])]
    rim = rng.uniform(0.025, 0.06)
    parts.append(turned([(radius, height - rim), (radius + rim, height - rim), (radius, height)]))
    for level in rng.uniform(0.3, 0.8, rng.integers(0, 3)):
        at = foot + (radius - foot) * level
        y = height * level
        parts.append(turned([(at, y - 0.02), (at + 0.03, y), (at, y + 0.02)]))
    swing = np.pi * rng.choice((0.5, rng.uniform(0.15, 0.85), -0.12))
    turn = np.linspace(0, np.pi, 16)
    ear = radius + rim
    lift = ear * rng.uniform(0.85, 1.1)
    out = np.sin(turn) * lift
    rise = height - rim / 2 + np.sin(swing) * out
    path = np.column_stack((np.cos(turn) * ear, rise, np.cos(swing) * out))
    # A lowered handle is outside the wall, at the distance of the rim.
    across = (0, -np.cos(swing), np.sin(swing))
    parts.append(tube(path, rng.uniform(0.018, 0.03), 8, across))
    for side in (-1, 1):
        parts.append(rod((side * radius * 0.97, height - rim, 0), (side * ear, height, 0), 0.05))
    return join(parts)


def goblet(rng: Generator) -> Trimesh:
    """Return a stemmed glass with a round, tall, conical or tulip-shaped bowl."""
    foot = rng.uniform(0.2, 0.3)
    stem = rng.uniform(0.025, 0.045)
    rise = rng.uniform(0.15, 0.55)
    deep = 1.0 - rise
    wide = rng.uniform(0.18, 0.42)
    start = [(foot, 0.0), (foot * 0.5, 0.03), (stem, 0.08), (stem, rise * 0.95)]
    if rng.random() < 0.25:  # conical
        return turned([(0, 0), *smooth(start, 12), (stem, rise), (wide, 1.0)])
    mouth = rng.uniform(0.7, 1.1)
    glass = [
        (stem, rise),
        (wide * 0.75, rise + deep * 0.15),
        (wide, rise + deep * rng.uniform(0.4, 0.6)),
        (wide * mouth, 1.0),
    ]
    parts = [turned([(0.0, 0.0), *smooth(start, 12), *smooth(glass, 18)])]
    if rng.random() < 0.4:
        knob = stem * rng.uniform(1.6, 2.4)
        y = rise * rng.uniform(0.4, 0.8)
        half = 0.04
        parts.append(turned(smooth([(stem, y - half), (knob, y), (stem, y + half)], 9), 16))
    return join(parts)


def teapot(rng: Generator) -> Trimesh:
    """Return a teapot with lid, spout, and a handle at the back or over the top."""
    radius = 0.5
    height = rng.uniform(0.6, 1.1)
    foot = radius * rng.uniform(0.5, 0.8)
    mouth = radius * rng.uniform(0.35, 0.6)
    widest = height * rng.uniform(0.3, 0.55)
    wall = smooth([(foot, 0), (radius, widest), (mouth, height)], 18)
    dome = rng.uniform(0.06, 0.16)
    lid = smooth([(mouth, height), (mouth * 0.7, height + dome * 0.7), (0, height + dome)], 8)
    knob = rng.uniform(0.045, 0.075)
    ball = height + dome + knob * 0.8 + knob * np.array((-1, -0.7, 0, 0.7, 1))
    ball_profile = np.column_stack((knob * np.array((0, 0.7, 1, 0.7, 0)), ball))
    parts = named("vessel", turned([(0.0, 0.0), *wall]))
    parts += named("lid", turned(lid), turned(ball_profile, 12))
    reach = rng.uniform(0.3, 0.5)
    tip = height * rng.uniform(0.85, 1.1)
    root = widest * rng.uniform(0.6, 1.0)
    spout = [
        (-radius * 0.85, root, 0),
        (-radius - reach * 0.45, root + (tip - root) * 0.3, 0),
        (-radius - reach * 0.7, root + (tip - root) * 0.75, 0),
        (-radius - reach, tip, 0),
    ]
    wide = rng.uniform(0.09, 0.14)
    widths = np.linspace(wide, wide * 0.4, 12)
    parts += named("spout", tube(smooth(spout, 12), widths, 12, across=(0, 0, 1)))
    thick = rng.uniform(0.03, 0.05)
    if rng.random() < 0.25:  # over the top
        turn = np.linspace(0, np.pi, 16)
        y = height * 0.8
        start = np.interp(y, wall[:, 1], wall[:, 0])
        rise = y + np.sin(turn) * rng.uniform(0.5, 0.75)
        path = np.column_stack((np.cos(turn) * start, rise, np.zeros(16)))
        parts += named("handle", tube(path, thick, 10, across=(0, 0, 1)))
    else:
        top = height * rng.uniform(0.75, 0.92)
        low = height * rng.uniform(0.15, 0.35)
        parts += named("handle", _handle(wall, top, low, rng.uniform(0.28, 0.45), thick))
    return join(parts)


def _handle(wall: Array, top: float, low: float, reach: float, thick: float) -> Trimesh:
    """Return a curved handle between two heights of a wall; on the left for negative reach."""
    side = np.sign(reach)
    # The ends are slightly inside the wall, so that there is no gap.
    start, end = (
        np.array((side * 0.96 * np.interp(y, wall[:, 1], wall[:, 0]), y, 0)) for y in (top, low)
    )
    turn = np.linspace(0, np.pi, 14)
    share = ((1 - np.cos(turn)) / 2)[:, None]
    path = start * (1 - share) + end * share  # half an oval
    path[:, 0] += reach * np.sin(turn) ** 0.8
    return tube(path, thick, 10, across=(0, 0, 1))
