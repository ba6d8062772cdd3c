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
    waists = (1.0, rng.uniform(0.72, 0.88), rng.uniform(1.1, 1.25))
    waist = radius * waists[kind]
    waist_height = shoulder * rng.uniform(0.4, 0.6)
    body = [
        (radius * 0.9, 0.0),
        (radius, 0.04),
        (waist, waist_height),
        (radius, shoulder),
        (neck, start),
        (neck, height),
    ]
    is_straight = kind == 0
    if is_straight:  # a smooth curve would round off the wall
        del body[2]
    wall = smooth(body, 28)
    parts = [turned([(0.0, 0.0), *wall])]
    has_cap = rng.random() < 0.7
    if has_cap:
        cap_radius = neck * rng.uniform(1.15, 1.5)
        parts.append(disc(cap_radius, (height - 0.09, height + 0.03)))
    else:
        lip = neck * 1.25
        parts.append(turned([(lip, height - 0.05), (lip, height)]))
    return join(parts)


def vase(rng: Generator) -> Trimesh:
    """Return a vase with foot, belly, neck and lip, sometimes with two handles; or a beaker."""
    belly = rng.uniform(0.24, 0.45)
    height = 1.0
    foot = belly * rng.uniform(0.4, 0.7)
    neck = belly * rng.uniform(0.28, 0.85)
    widest_lip = belly * 1.15
    lip = min(neck * rng.uniform(1.05, 1.9), widest_lip)
    low = rng.uniform(0.3, 0.55)
    high = rng.uniform(0.72, 0.85)
    is_beaker = rng.random() < 0.25
    if is_beaker:  # no belly, wider at the top
        middle = foot * rng.uniform(0.9, 1.3)
        profile = [(foot, 0), (middle, low), (belly, height)]
        wall = smooth(profile, 24)
        return turned([(0.0, 0.0), *wall])
    profile = [
        (foot, 0),
        (foot * 0.85, 0.06),
        (belly, low),
        (neck, high),
        (lip, height),
    ]
    wall = smooth(profile, 32)
    parts = [turned([(0.0, 0.0), *wall])]
    if rng.random() < 0.3:
        reach = rng.uniform(0.12, 0.22)
        thick = rng.uniform(0.022, 0.035)
        upper = (high + height) / 2
        lower = (low + high) / 2
        for side in (-1, 1):
            parts.append(_handle(wall, upper, lower, side * reach, thick))
    return join(parts)


def bowl(rng: Generator) -> Trimesh:
    """Return a bowl on a foot ring; a deep one is similar to a cup without a handle."""
    radius = 0.5
    depth = rng.uniform(0.28, 0.75)
    foot = radius * rng.uniform(0.3, 0.55)
    ring = rng.uniform(0.02, 0.14)
    bulge = rng.uniform(1.5, 3.2)
    up = np.linspace(0, 1, 16)
    share_out = (1 - (1 - up) ** bulge) ** (1 / 1.3)
    wall = foot + (radius - foot) * share_out
    profile = np.column_stack((wall, ring + depth * up))
    body = turned([(0.0, ring), *profile])
    stand_radius = foot * 0.95
    stand = turned([(stand_radius, 0), (stand_radius, ring)])
    parts = [body, stand]
    if rng.random() < 0.4:
        lip = rng.uniform(0.03, 0.1)
        edge = ring + depth
        lip_end = (radius + lip, edge + lip * 0.3)
        parts.append(turned([(radius, edge), lip_end]))
    return join(parts)


def cup(rng: Generator) -> Trimesh:
    """Return a cup with a handle, sometimes with a saucer."""
    radius = rng.uniform(0.34, 0.5)
    height = rng.uniform(0.55, 1.0)
    foot = radius * rng.uniform(0.55, 1.0)
    waist = rng.uniform(0.85, 1.12)
    middle = (radius + foot) / 2 * waist
    wall_profile = [(foot, 0), (middle, height * 0.45), (radius, height)]
    wall = smooth(wall_profile, 14)
    parts = named("vessel", turned([(0.0, 0.0), *wall]))
    top = height * rng.uniform(0.78, 0.92)
    low = height * rng.uniform(0.15, 0.4)
    reach = rng.uniform(0.15, 0.36)
    thick = rng.uniform(0.025, 0.05)
    parts += named("handle", _handle(wall, top, low, reach, thick))
    if rng.random() < 0.25:
        plate = radius * rng.uniform(1.5, 1.9)
        saucer = [(0, -0.03), (plate * 0.6, -0.03), (plate, 0.05)]
        parts += named("saucer", turned(saucer))
    return join(parts)


def bucket(rng: Generator) -> Trimesh:
    """Return a bucket with a conical wall, a rim and a handle at a random angle."""
    radius = 0.5
    height = rng.uniform(0.75, 1.1)
    foot = radius * rng.uniform(0.6, 0.85)
    body = turned([(0, 0), (foot, 0), (radius, height)])
    parts = [body]
    rim = rng.uniform(0.025, 0.06)
    edge = [
        (radius, height - rim),
        (radius + rim, height - rim),
        (radius, height),
    ]
    parts.append(turned(edge))
    for level in rng.uniform(0.3, 0.8, rng.integers(0, 3)):
        at = foot + (radius - foot) * level
        y = height * level
        ridge = [
            (at, y - 0.02),
            (at + 0.03, y),
            (at, y + 0.02),
        ]
        parts.append(turned(ridge))
    swings = (0.5, rng.uniform(0.15, 0.85), -0.12)
    swing = np.pi * rng.choice(swings)
    ear = radius + rim
    parts.append(_bail(rng, ear, height - rim / 2, swing))
    for side in (-1, 1):
        inner = (side * radius * 0.97, height - rim, 0)
        outer = (side * ear, height, 0)
        parts.append(rod(inner, outer, 0.05))
    return join(parts)


def _bail(rng: Generator, ear: float, y: float, swing: float) -> Trimesh:
    """Return the handle of a bucket, half an oval between both ears.

    Args:
        rng: chooses its measures.
        ear: distance of an ear from the axis.
        y: height of the ears.
        swing: angle of the handle above the horizontal, in radians.
    """
    turn = np.linspace(0, np.pi, 16)
    lift = ear * rng.uniform(0.85, 1.1)
    out = np.sin(turn) * lift
    up = np.sin(swing)
    forward = np.cos(swing)
    path = np.column_stack((np.cos(turn) * ear, y + up * out, forward * out))
    # A lowered handle is outside the wall, at the distance of the rim.
    across = (0, -forward, up)
    radius = rng.uniform(0.018, 0.03)
    return tube(path, radius, 8, across)


def goblet(rng: Generator) -> Trimesh:
    """Return a stemmed glass with a round, tall, conical or tulip-shaped bowl."""
    foot = rng.uniform(0.2, 0.3)
    stem = rng.uniform(0.025, 0.045)
    rise = rng.uniform(0.15, 0.55)
    deep = 1.0 - rise
    wide = rng.uniform(0.18, 0.42)
    foot_profile = [
        (foot, 0.0),
        (foot * 0.5, 0.03),
        (stem, 0.08),
        (stem, rise * 0.95),
    ]
    lower = smooth(foot_profile, 12)
    is_conical = rng.random() < 0.25
    if is_conical:
        cone = [(stem, rise), (wide, 1.0)]
        return turned([(0, 0), *lower, *cone])
    mouth = rng.uniform(0.7, 1.1)
    widest = rise + deep * rng.uniform(0.4, 0.6)
    glass = [
        (stem, rise),
        (wide * 0.75, rise + deep * 0.15),
        (wide, widest),
        (wide * mouth, 1.0),
    ]
    upper = smooth(glass, 18)
    parts = [turned([(0.0, 0.0), *lower, *upper])]
    if rng.random() < 0.4:
        width = stem * rng.uniform(1.6, 2.4)
        y = rise * rng.uniform(0.4, 0.8)
        knob = [
            (stem, y - 0.04),
            (width, y),
            (stem, y + 0.04),
        ]
        parts.append(turned(smooth(knob, 9), 16))
    return join(parts)


def teapot(rng: Generator) -> Trimesh:
    """Return a teapot with lid, spout, and a handle at the back or over the top."""
    radius = 0.5
    height = rng.uniform(0.6, 1.1)
    foot = radius * rng.uniform(0.5, 0.8)
    mouth = radius * rng.uniform(0.35, 0.6)
    widest = height * rng.uniform(0.3, 0.55)
    profile = [(foot, 0), (radius, widest), (mouth, height)]
    wall = smooth(profile, 18)
    parts = named("vessel", turned([(0.0, 0.0), *wall]))
    parts += named("lid", *_lid(rng, mouth, height))
    parts += named("spout", _spout(rng, radius, height, widest))
    thick = rng.uniform(0.03, 0.05)
    is_over_the_top = rng.random() < 0.25
    if is_over_the_top:
        handle = _arch(rng, wall, height * 0.8, thick)
    else:
        top = height * rng.uniform(0.75, 0.92)
        low = height * rng.uniform(0.15, 0.35)
        reach = rng.uniform(0.28, 0.45)
        handle = _handle(wall, top, low, reach, thick)
    parts += named("handle", handle)
    return join(parts)


def _lid(rng: Generator, mouth: float, height: float) -> list[Trimesh]:
    """Return a domed lid with a knob."""
    dome = rng.uniform(0.06, 0.16)
    profile = [
        (mouth, height),
        (mouth * 0.7, height + dome * 0.7),
        (0, height + dome),
    ]
    lid = turned(smooth(profile, 8))
    radius = rng.uniform(0.045, 0.075)
    centre = height + dome + radius * 0.8
    ball_heights = centre + radius * np.array((-1, -0.7, 0, 0.7, 1))
    ball_radii = radius * np.array((0, 0.7, 1, 0.7, 0))
    ball = np.column_stack((ball_radii, ball_heights))
    knob = turned(ball, 12)
    return [lid, knob]


def _spout(rng: Generator, radius: float, height: float, widest: float) -> Trimesh:
    reach = rng.uniform(0.3, 0.5)
    tip = height * rng.uniform(0.85, 1.1)
    root = widest * rng.uniform(0.6, 1.0)
    rise = tip - root
    path = [
        (-radius * 0.85, root, 0),
        (-radius - reach * 0.45, root + rise * 0.3, 0),
        (-radius - reach * 0.7, root + rise * 0.75, 0),
        (-radius - reach, tip, 0),
    ]
    wide = rng.uniform(0.09, 0.14)
    radii = np.linspace(wide, wide * 0.4, 12)
    return tube(smooth(path, 12), radii, 12, across=(0, 0, 1))


def _arch(rng: Generator, wall: Array, y: float, thick: float) -> Trimesh:
    """Return a handle over the top, from a height of the wall."""
    turn = np.linspace(0, np.pi, 16)
    start = _radius_at(wall, y)
    rise = y + np.sin(turn) * rng.uniform(0.5, 0.75)
    x = np.cos(turn) * start
    path = np.column_stack((x, rise, np.zeros(16)))
    return tube(path, thick, 10, across=(0, 0, 1))


def _handle(wall: Array, top: float, low: float, reach: float, thick: float) -> Trimesh:
    """Return a curved handle between two heights of a wall; on the left for negative reach."""
    # The ends are slightly inside the wall, so that there is no gap.
    inside = np.sign(reach) * 0.96
    start_x = inside * _radius_at(wall, top)
    end_x = inside * _radius_at(wall, low)
    start = np.array((start_x, top, 0))
    end = np.array((end_x, low, 0))
    turn = np.linspace(0, np.pi, 14)
    share = ((1 - np.cos(turn)) / 2)[:, None]
    path = start * (1 - share) + end * share  # half an oval
    bulge = np.sin(turn) ** 0.8
    path[:, 0] += reach * bulge
    return tube(path, thick, 10, across=(0, 0, 1))


def _radius_at(wall: Array, y: float) -> float:
    """Return the radius of a wall ``(P, 2)`` at a height."""
    heights = wall[:, 1]
    radii = wall[:, 0]
    return np.interp(y, heights, radii)
