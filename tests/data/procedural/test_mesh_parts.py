"""Sizes, volumes and areas of mesh parts against closed formulas."""

import numpy as np
import pytest

from mops_lightning.data.procedural import mesh_parts


def test_cushion_has_size_and_volume():
    a = 2.0
    b = 1.0
    c = 1.5
    r = 0.3
    mesh = mesh_parts.cushion((0, a), (0, b), (0, c), r)
    x = a - 2 * r
    y = b - 2 * r
    z = c - 2 * r
    exact = x * y * z + 2 * r * (x * y + y * z + z * x) + np.pi * r**2 * (x + y + z)
    exact += 4 / 3 * np.pi * r**3
    assert np.allclose(mesh.bounds, np.array([(0, 0, 0), (a, b, c)]))
    assert 0.9 * exact < mesh.volume < exact


def test_tube_has_volume():
    straight = mesh_parts.rod((1, 2, 3), (1, 5, 3), 0.5, sections=64)
    assert straight.volume == pytest.approx(3 * np.pi * 0.25, rel=0.01)
    square = mesh_parts.rod((0, 0, 0), (0, 2, 0), 0.5, sections=4)
    assert np.allclose(square.bounds, [[-0.5, 0, -0.5], [0.5, 2, 0.5]])
    ring = np.linspace(0, 2 * np.pi, 65)
    circle = np.column_stack((np.cos(ring), np.zeros(65), np.sin(ring)))
    torus = mesh_parts.tube(circle, 0.1, sections=32, across=(0, 1, 0))
    assert abs(torus.volume) == pytest.approx(2 * np.pi**2 * 0.01, rel=0.02)


def test_box_fills_spans_and_loft_of_squares_is_block():
    assert np.allclose(mesh_parts.box((0, 1), (2, 4), (-3, 0)).bounds, [[0, 2, -3], [1, 4, 0]])
    square = np.array([(0, 0, 0), (0, 1, 0), (1, 1, 0), (1, 0, 0)])
    block = mesh_parts.loft((square, square + np.array((0, 0, 3))))
    assert abs(block.volume) == pytest.approx(3)
    assert block.area == pytest.approx(14)


def test_turned_is_surface_of_revolution():
    mesh = mesh_parts.turned([(1, 0), (1, 3)], sections=64)
    assert np.allclose(mesh.bounds, [[-1, 0, -1], [1, 3, 1]])
    assert mesh.area == pytest.approx(6 * np.pi, rel=0.01)


def test_smooth_interpolates_without_overshoot():
    curve = mesh_parts.smooth([(1, 0), (3, 1), (0.5, 2)], steps=50)
    assert np.allclose(curve[[0, -1]], [(1, 0), (0.5, 2)])
    assert curve[:, 0].min() >= 0.5
    assert curve[:, 0].max() <= 3


def test_join_keeps_all_faces():
    parts = [mesh_parts.box((0, 1), (0, 1), (0, 1)), mesh_parts.rod((5, 0, 0), (5, 1, 0), 0.1)]
    mesh = mesh_parts.join(parts)
    assert mesh.area == pytest.approx(sum(part.area for part in parts))
    assert mesh.bounds[1, 0] > 5
