"""Airplane builder."""

import numpy as np
from numpy.random import Generator
from trimesh import Trimesh

from mops_lightning.data.procedural.mesh_parts import Array, join, loft, named, rod, smooth, tube


def airplane(rng: Generator) -> Trimesh:
    """Return an airplane with its nose to +z: a jet or a propeller plane.

    Jets have engines under the wings or at the tail. Some propeller planes have high wings.
    """
    length = 2.0
    radius = rng.uniform(0.09, 0.15)
    nose = length / 2
    tail = -length / 2
    z = np.array((nose, nose - 0.05, nose - 0.2, nose - 0.4, tail * 0.35, tail * 0.8, tail))
    y = radius * np.array((-0.3, -0.2, -0.05, 0, 0, 0.4, 0.75))
    wide = radius * np.array((0.12, 0.45, 0.85, 1, 1, 0.55, 0.15))
    body = smooth(np.column_stack((y, z, wide)), 24)
    path = np.column_stack((np.zeros(24), body[:, 0], body[:, 1]))
    parts = named("hull", tube(path, body[:, 2], 20, across=(1, 0, 0)))

    prop = rng.random() < 0.3
    span = rng.uniform(0.7, 1.1)
    sweep = rng.uniform(-0.05, 0.08) if prop else rng.uniform(0.3, 0.75)
    root_chord = rng.uniform(0.3, 0.5)
    tip_chord = root_chord * rng.uniform(0.3, 0.8 if prop else 0.5)
    level = radius * (0.8 if prop and rng.random() < 0.6 else -0.5)
    dihedral = rng.uniform(0.0, 0.12)
    root_z = rng.uniform(0.1, 0.4)
    for side in (-1, 1):
        root = np.array((side * radius * 0.5, level, root_z))
        tip = np.array((side * span, level + dihedral * span, root_z - sweep * span))
        parts += named("wing", _wing(root, tip, root_chord, tip_chord))
    tall = rng.uniform(0.25, 0.42)
    high = rng.random() < 0.25
    rear = tail + 0.32
    back = rng.uniform(0.15, 0.3)
    fin_top = np.array((0, radius * 0.5 + tall, rear - back))
    fin = np.array((0, radius * 0.3, rear))
    parts += named("tail", _wing(fin, fin_top, 0.32, 0.16, upright=True))
    half = span * rng.uniform(0.32, 0.45)
    tail_y = fin_top[1] if high else radius * 0.5
    tail_z = fin_top[2] if high else rear - 0.05
    for side in (-1, 1):
        tip = np.array((side * half, tail_y + 0.02, tail_z - back * half / 0.4))
        parts += named("tail", _wing(np.array((0, tail_y, tail_z)), tip, 0.24, 0.12))
    if prop:
        parts += _propeller(rng, nose, -radius * 0.3)
        return join(parts)
    size = radius * rng.uniform(0.4, 0.55)
    if high:  # at the sides of the body, below the high tailplane
        return join(parts + _engine(rng, radius * 1.35, radius * 0.45, -0.45, size))
    for share in (0.36,) if rng.random() < 0.65 else (0.3, 0.58):
        edge = root_z - sweep * share * span
        parts += _engine(rng, share * span, level - size * 1.3, edge, size)
    return join(parts)


def _wing(
    root: Array, tip: Array, root_chord: float, tip_chord: float, upright: bool = False
) -> Trimesh:
    """Return a flat wing between the leading edges at its root and tip."""
    chord = (0, -0.25, -0.6, -1, -0.6, -0.25)
    rise = (0, 0.06, 0.05, 0, -0.05, -0.06)
    level = np.zeros(6)
    shape = np.column_stack((rise, level, chord) if upright else (level, rise, chord))
    return loft((root + root_chord * shape, tip + tip_chord * shape))


def _propeller(rng: Generator, nose: float, y: float) -> list[Trimesh]:
    blades = int(rng.integers(2, 5))
    start = rng.uniform(0, np.pi)
    hub = np.array((0, y, nose + 0.03))
    parts = [rod((0, y, nose - 0.03), (0, y, nose + 0.08), (0.05, 0.015))]
    for turn in start + 2 * np.pi * np.arange(blades) / blades:
        out = np.array((np.cos(turn), np.sin(turn), 0))
        path = hub + np.outer((0.02, 0.12, 0.25), out)
        parts.append(tube(path, (0.02, 0.035, 0.02), 8, across=(0, 0, 1), flatten=0.3))
    return named("engine", *parts)


def _engine(rng: Generator, x: float, y: float, z: float, size: float) -> list[Trimesh]:
    """Return a jet engine on each side; ``size`` is its radius at the front."""
    long = rng.uniform(0.22, 0.32)
    front = z + long * 0.4
    rear = z - long * 0.6
    sides = (rod((at, y, front), (at, y, rear), (size, size * 0.7), 14) for at in (-x, x))
    return named("engine", *sides)
