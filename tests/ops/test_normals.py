"""Normals by plane fits, beside NumPy's eigenvectors and a k-d tree."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from mops_lightning.ops.normals import estimate_normals


def plain_normals(points, neighbours):
    """The eigenvector of the smallest eigenvalue, point by point."""
    rows = cKDTree(points).query(points, neighbours)[1]
    normals = []
    for near in points[rows]:
        offsets = near - near.mean(0)
        normals.append(np.linalg.eigh(offsets.T @ offsets)[1][:, 0])
    return np.array(normals)


@pytest.mark.parametrize("place", [0.0, 4e6])
def test_normals_are_the_directions_of_least_variance_anywhere_on_a_map(place):
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1, 1, (2, 400))
    noise = rng.normal(0, 0.01, 400)
    z = np.sin(2 * x) * np.cos(y) + noise
    surface = np.column_stack([x, y, z])

    normals = estimate_normals(surface + place, 9)

    cosines = (normals * plain_normals(surface, 9)).sum(1)
    assert np.abs(cosines) == pytest.approx(1, abs=1e-6)
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1)


def test_normals_of_a_plane_are_its_normal():
    rng = np.random.default_rng(0)
    across = np.array([2.0, -1, 2]) / 3
    points = rng.normal(size=(100, 3))
    points -= (points @ across)[:, None] * across

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
