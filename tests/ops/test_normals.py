"""Normals by plane fits, beside NumPy's eigenvectors and a k-d tree."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from mops_lightning.ops import normals as module
from mops_lightning.ops.normals import estimate_normals, upward_normals


def plain_normals(points, neighbours):
    """The eigenvector of the smallest eigenvalue, point by point."""
    _, rows = cKDTree(points).query(points, neighbours)
    normals = []
    for near in points[rows]:
        offsets = near - near.mean(0)
        _, axes = np.linalg.eigh(offsets.T @ offsets)
        normals.append(axes[:, 0])
    return np.array(normals)


def wavy_surface():
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1, 1, (2, 400))
    noise = rng.normal(0, 0.01, 400)
    z = np.sin(2 * x) * np.cos(y) + noise
    return np.column_stack([x, y, z])


@pytest.mark.parametrize("place", [0.0, 4e6])
def test_normals_are_the_directions_of_least_variance_anywhere_on_a_map(place):
    surface = wavy_surface()

    normals = estimate_normals(surface + place, 9)

    expected = plain_normals(surface, 9)
    cosines = (normals * expected).sum(1)
    lengths = np.linalg.norm(normals, axis=1)
    assert np.abs(cosines) == pytest.approx(1, abs=1e-6)
    assert lengths == pytest.approx(1)


def test_normals_are_those_of_12_neighbours_by_default():
    surface = wavy_surface()

    normals = estimate_normals(surface)

    assert np.array_equal(normals, estimate_normals(surface, 12))


def test_normals_of_a_cloud_in_parts_are_those_of_the_whole(monkeypatch):
    surface = wavy_surface()
    whole = estimate_normals(surface)
    monkeypatch.setattr(module, "PART", 150)

    in_parts = estimate_normals(surface)

    assert np.array_equal(in_parts, whole)


GROUND = np.stack(np.meshgrid(np.arange(6.0), np.arange(6.0)), 2).reshape(-1, 2)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_upward_normals_of_a_plane_point_along_its_positive_axis(axis):
    plane = np.insert(GROUND, axis, 0.0, axis=1)

    normals = upward_normals(plane)

    expected = np.eye(3)[axis]
    assert normals == pytest.approx(np.tile(expected, (36, 1)))


@pytest.mark.parametrize("sign", [1, -1])
def test_upward_normals_have_a_positive_z_whichever_way_the_surface_leans(sign):
    leaning = np.column_stack([GROUND, sign * GROUND[:, 0]])

    normals = upward_normals(leaning)

    half = 0.5**0.5
    expected = np.array([-sign * half, 0, half])
    assert normals == pytest.approx(np.tile(expected, (36, 1)))


def test_normals_of_a_plane_are_its_normal():
    rng = np.random.default_rng(0)
    across = np.array([2.0, -1, 2]) / 3
    points = rng.normal(size=(100, 3))
    heights = points @ across
    points -= heights[:, None] * across

    normals = estimate_normals(points)

    assert np.abs(normals @ across) == pytest.approx(1)


def test_normals_of_a_line_are_across():
    direction = np.array([1.0, 2.0, 3.0])
    line = np.arange(6.0)[:, None] * direction

    normals = estimate_normals(line)

    assert normals @ direction == pytest.approx(0, abs=1e-12)


def test_normals_of_equal_points_point_up():
    equal = np.full((5, 3), 7.0)
    alone = np.array([[1.0, 2.0, 3.0]])

    assert estimate_normals(equal).tolist() == [[0, 0, 1]] * 5
    assert estimate_normals(alone).tolist() == [[0, 0, 1]]


@pytest.mark.parametrize(
    ("estimated", "upward"),
    [
        ([0.6, 0.0, -0.8], [-0.6, 0.0, 0.8]),
        ([-0.6, 0.0, 0.8], [-0.6, 0.0, 0.8]),
        ([0.6, -0.8, 0.0], [-0.6, 0.8, 0.0]),
        ([-0.6, 0.8, 0.0], [-0.6, 0.8, 0.0]),
        ([-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]),
        ([1.0, 0.0, 0.0], [1.0, 0.0, 0.0]),
    ],
)
def test_upward_normals_have_a_positive_z_then_y_then_x(estimated, upward, monkeypatch):
    normals = np.array([estimated])
    monkeypatch.setattr(module, "estimate_normals", lambda _: normals)

    assert upward_normals(np.zeros((1, 3))).tolist() == [upward]
