"""Builder of airplanes."""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from trimesh import Trimesh

from mops_lightning.data.procedural.mesh_parts import Array, join, loft, named, rod, smooth, tube

NOSE = 1.0
TAIL = -1.0
"""Both ends of the hull, on the z axis."""


def airplane(rng: Generator) -> Trimesh:
    """Return an airplane with its nose to +z: a jet or a propeller plane.

    Jets have engines under the wings or at the tail. Some propeller planes have high wings.
    """
    radius = rng.uniform(0.09, 0.15)
    parts = named("hull", _hull(radius))
    has_propeller = rng.random() < 0.3
    wings = _Wings.drawn(rng, radius, has_propeller)
    parts += named("wing", wings.mesh(-1), wings.mesh(1))
    tall = rng.uniform(0.25, 0.42)
    has_high_tailplane = rng.random() < 0.25
    back = rng.uniform(0.15, 0.3)
    half = wings.span * rng.uniform(0.32, 0.45)
    parts += named("tail", *_tail(radius, tall, back, half, has_high_tailplane))
    if has_propeller:
        parts += _propeller(rng, NOSE, -radius * 0.3)
        return join(parts)
    size = radius * rng.uniform(0.4, 0.55)
    if has_high_tailplane:  # at the sides of the body, below the high tailplane
        parts += _engine(rng, radius * 1.35, radius * 0.45, -0.45, size)
        return join(parts)
    has_two_engines = rng.random() < 0.65
    shares = [0.3, 0.58]
    if has_two_engines:
        shares = [0.36]
    y = wings.level - size * 1.3
    for share in shares:
        x = share * wings.span
        edge = wings.root_z - wings.sweep * share * wings.span
        parts += _engine(rng, x, y, edge, size)
    return join(parts)


def _hull(radius: float) -> Trimesh:
    z = np.array((NOSE, NOSE - 0.05, NOSE - 0.2, NOSE - 0.4, TAIL * 0.35, TAIL * 0.8, TAIL))
    y = radius * np.array((-0.3, -0.2, -0.05, 0, 0, 0.4, 0.75))
    wide = radius * np.array((0.12, 0.45, 0.85, 1, 1, 0.55, 0.15))
    profile = np.column_stack((y, z, wide))
    body_y, body_z, body_radii = smooth(profile, 24).T
    path = np.column_stack((np.zeros(24), body_y, body_z))
    return tube(path, body_radii, 20, across=(1, 0, 0))


@dataclass
class _Wings:
    """The measures of both wings.

    Attributes:
        radius: of the hull.
        span: of one wing.
        sweep: how far its tip is behind its root, relative to the span.
        root_chord: depth at the hull.
        tip_chord: depth at the tip.
        level: height of the root.
        dihedral: how far the tip is above the root, relative to the span.
        root_z: leading edge at the root.
    """

    radius: float
    span: float
    sweep: float
    root_chord: float
    tip_chord: float
    level: float
    dihedral: float
    root_z: float

    @classmethod
    def drawn(cls, rng: Generator, radius: float, has_propeller: bool) -> "_Wings":
        """Return wings of random measures."""
        span = rng.uniform(0.7, 1.1)
        if has_propeller:
            sweep = rng.uniform(-0.05, 0.08)
            widest_tip = 0.8
        else:
            sweep = rng.uniform(0.3, 0.75)
            widest_tip = 0.5
        root_chord = rng.uniform(0.3, 0.5)
        tip_chord = root_chord * rng.uniform(0.3, widest_tip)
        is_high = has_propeller and rng.random() < 0.6
        level = radius * -0.5
        if is_high:
            level = radius * 0.8
        return cls(
            radius=radius,
            span=span,
            sweep=sweep,
            root_chord=root_chord,
            tip_chord=tip_chord,
            level=level,
            dihedral=rng.uniform(0.0, 0.12),
            root_z=rng.uniform(0.1, 0.4),
        )

    def mesh(self, side: int) -> Trimesh:
        """Return the left wing, for -1, or the right one, for 1."""
        tip_y = self.level + self.dihedral * self.span
        tip_z = self.root_z - self.sweep * self.span
        root_x = side * self.radius * 0.5
        root = np.array((root_x, self.level, self.root_z))
        tip = np.array((side * self.span, tip_y, tip_z))
        return _wing(root, tip, self.root_chord, self.tip_chord)


def _tail(
    radius: float,
    tall: float,
    back: float,
    half: float,
    has_high_tailplane: bool,
) -> list[Trimesh]:
    """Return the fin and both halves of the tailplane.

    Args:
        radius: of the hull.
        tall: height of the fin.
        back: how far its top is behind its foot.
        half: width of each half of the tailplane.
        has_high_tailplane: whether it is at the top of the fin.
    """
    rear = TAIL + 0.32
    top_y = radius * 0.5 + tall
    top = np.array((0, top_y, rear - back))
    foot = np.array((0, radius * 0.3, rear))
    parts = [_wing(foot, top, 0.32, 0.16, upright=True)]
    root = np.array((0, radius * 0.5, rear - 0.05))
    if has_high_tailplane:
        root = top
    _, y, z = root
    for side in (-1, 1):
        tip_z = z - back * half / 0.4
        tip = np.array((side * half, y + 0.02, tip_z))
        parts.append(_wing(root, tip, 0.24, 0.12))
    return parts


def _wing(
    root: Array,
    tip: Array,
    root_chord: float,
    tip_chord: float,
    upright: bool = False,
) -> Trimesh:
    """Return a flat wing between the leading edges at its root and tip."""
    chord = (0, -0.25, -0.6, -1, -0.6, -0.25)
    rise = (0, 0.06, 0.05, 0, -0.05, -0.06)
    level = np.zeros(6)
    if upright:
        shape = np.column_stack((rise, level, chord))
    else:
        shape = np.column_stack((level, rise, chord))
    root_ring = root + root_chord * shape
    tip_ring = tip + tip_chord * shape
    return loft((root_ring, tip_ring))


def _propeller(rng: Generator, nose: float, y: float) -> list[Trimesh]:
    blades = int(rng.integers(2, 5))
    start = rng.uniform(0, np.pi)
    hub = np.array((0, y, nose + 0.03))
    rear_of_hub = (0, y, nose - 0.03)
    front_of_hub = (0, y, nose + 0.08)
    parts = [rod(rear_of_hub, front_of_hub, (0.05, 0.015))]
    turns = start + 2 * np.pi * np.arange(blades) / blades
    for turn in turns:
        out = np.array((np.cos(turn), np.sin(turn), 0))
        path = hub + np.outer((0.02, 0.12, 0.25), out)
        blade = tube(path, (0.02, 0.035, 0.02), 8, across=(0, 0, 1), flatten=0.3)
        parts.append(blade)
    return named("engine", *parts)


def _engine(rng: Generator, x: float, y: float, z: float, size: float) -> list[Trimesh]:
    """Return a jet engine on each side; ``size`` is its radius at the front."""
    long = rng.uniform(0.22, 0.32)
    front = z + long * 0.4
    rear = z - long * 0.6
    radii = (size, size * 0.7)
    left = rod((-x, y, front), (-x, y, rear), radii, 14)
    right = rod((x, y, front), (x, y, rear), radii, 14)
    return named("engine", left, right)
