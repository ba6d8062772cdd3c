"""Sizes, volumes and areas of mesh parts against closed formulas."""

import numpy as np
import pytest

from mops_lightning.data.procedural import mesh_parts


def test_cushion_has_size_and_volume():
    radius = 0.3
    x = 2.0 - 2 * radius
    y = 1.0 - 2 * radius
    z = 1.5 - 2 * radius
    core = x * y * z
    faces = x * y + y * z + z * x
    sides = 2 * radius * faces
    edges = np.pi * radius**2 * (x + y + z)
    corners = 4 / 3 * np.pi * radius**3
    volume = core + sides + edges + corners

    mesh = mesh_parts.cushion((0, 2.0), (0, 1.0), (0, 1.5), radius)

    assert has_bounds(mesh, (0, 0, 0), (2.0, 1.0, 1.5))
    assert 0.9 * volume < mesh.volume < volume


def test_rod_has_volume_of_a_cylinder():
    rod = mesh_parts.rod((1, 2, 3), (1, 5, 3), 0.5, sections=64)

    expected = 3 * np.pi * 0.25
    assert rod.volume == pytest.approx(expected, rel=0.01)


def has_bounds(mesh, low, high):
    """Whether a mesh reaches from one corner to the other."""
    return np.allclose(mesh.bounds, [low, high])


def test_rod_of_four_sections_fills_its_square():
    rod = mesh_parts.rod((0, 0, 0), (0, 2, 0), 0.5, sections=4)

    assert has_bounds(rod, (-0.5, 0, -0.5), (0.5, 2, 0.5))


def test_tube_has_volume_of_a_torus():
    turn = np.linspace(0, 2 * np.pi, 65)
    circle = np.zeros((65, 3))
    circle[:, 0] = np.cos(turn)
    circle[:, 2] = np.sin(turn)

    torus = mesh_parts.tube(circle, 0.1, sections=32, across=(0, 1, 0))

    expected = 2 * np.pi**2 * 0.01
    assert abs(torus.volume) == pytest.approx(expected, rel=0.02)


def test_box_fills_spans():
    box = mesh_parts.box((0, 1), (2, 4), (-3, 0))

    assert has_bounds(box, (0, 2, -3), (1, 4, 0))


def test_loft_of_squares_is_block():
    square = np.array(
        [
            (0, 0, 0),
            (0, 1, 0),
            (1, 1, 0),
            (1, 0, 0),
        ]
    )
    opposite = square + np.array([0, 0, 3])

    block = mesh_parts.loft((square, opposite))

    assert abs(block.volume) == pytest.approx(3)
    assert block.area == pytest.approx(14)


def test_turned_is_surface_of_revolution():
    profile = [(1, 0), (1, 3)]

    mesh = mesh_parts.turned(profile, sections=64)

    expected = 6 * np.pi
    assert has_bounds(mesh, (-1, 0, -1), (1, 3, 1))
    assert mesh.area == pytest.approx(expected, rel=0.01)


def test_smooth_interpolates_without_overshoot():
    corners = [
        (1, 0),
        (3, 1),
        (0.5, 2),
    ]

    curve = mesh_parts.smooth(corners, steps=50)

    first = curve[0]
    last = curve[-1]
    assert np.allclose(first, (1, 0))
    assert np.allclose(last, (0.5, 2))
    radii = curve[:, 0]
    assert radii.min() >= 0.5
    assert radii.max() <= 3


def test_join_keeps_all_faces():
    box = mesh_parts.box((0, 1), (0, 1), (0, 1))
    rod = mesh_parts.rod((5, 0, 0), (5, 1, 0), 0.1)

    mesh = mesh_parts.join([box, rod])

    together = box.area + rod.area
    assert mesh.area == pytest.approx(together)
    assert mesh.bounds[1, 0] > 5
