"""Descriptions of neighbourhoods, beside a plain form and under motions."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mops_lightning.ops.kernel_normals import ellipsoids
from mops_lightning.ops.neighbourhoods import FEATURES, describe_neighbourhoods
from tests.ops.test_stability import box


def plain_ellipsoid(points, rows, place):
    """Compute the spread of one neighbourhood by NumPy's eigenvectors."""
    near = points[rows]
    covariance = np.cov(near.T, bias=True)
    variances, axes = np.linalg.eigh(covariance)
    normal = axes[:, 0]
    offset = points[place] - near.mean(0)
    height = offset @ normal
    beside = np.linalg.norm(offset - height * normal)
    return [*np.sqrt(variances), abs(height), beside], normal


def test_ellipsoids_equal_eigenvectors_of_numpy():
    points = box(100)
    _, nearest = cKDTree(points).query(points, k=12)
    rows = np.asarray(nearest)

    numbers, normals = ellipsoids(points, rows)

    for place in range(100):
        expected, normal = plain_ellipsoid(points, rows[place], place)
        assert numbers[place] == pytest.approx(expected, abs=1e-9)
        assert abs(normals[place] @ normal) == pytest.approx(1)


def plain_features(points):
    """Return the features of every point, one number after the other."""
    centred = points - points.mean(0)
    centred /= np.linalg.norm(centred, axis=1).mean()
    found: Any = cKDTree(centred).query(centred, k=24)
    distances, nearest = found
    spacing = np.median(distances[:, 5])
    normals = []
    for place in range(len(points)):
        _, normal = plain_ellipsoid(centred, nearest[place, :12], place)
        normals.append(normal)
    features = []
    for place, point in enumerate(centred):
        numbers = []
        for k in (6, 12, 24):
            near = nearest[place, :k]
            lengths, _ = plain_ellipsoid(centred, near, place)
            lengths.append(distances[place, k - 1])
            for length in lengths:
                numbers.append(logarithm(length / spacing))
        normal = normals[place]
        for k in (6, 12, 24):
            cosines = [abs(normal @ normals[row]) for row in nearest[place, :k]]
            numbers.append(logarithm(1 - np.mean(cosines)))
            numbers.append(logarithm(1 - min(cosines)))
        lever = np.cross(point, normal)
        numbers.append(np.linalg.norm(point))
        numbers.append(abs(point @ normal))
        numbers.append(logarithm(np.linalg.norm(lever)))
        numbers.append(np.log(spacing))
        features.append(numbers)
    return np.array(features)


def logarithm(number):
    """Return the logarithm of a number that may be zero."""
    return np.log(number + 0.01)


def test_features_equal_a_plain_form():
    points = box(150)

    features = describe_neighbourhoods(points).features

    assert features == pytest.approx(plain_features(points), abs=1e-6)


def test_features_of_turned_scaled_and_moved_cloud_are_the_same():
    points = box(200)
    turn = Rotation.from_rotvec([0.3, -1.2, 2.0]).as_matrix()

    features = describe_neighbourhoods(points).features
    moved_points = 40 * points @ turn.T + [500, -3, 20]
    moved = describe_neighbourhoods(moved_points).features

    assert features.shape == (200, FEATURES)
    assert moved == pytest.approx(features, abs=1e-6)


@pytest.mark.parametrize("number", [1, 2, 5, 30])
def test_features_of_coincident_points_are_finite(number):
    found = describe_neighbourhoods(np.full((number, 3), 7.0))

    assert np.isfinite(found.features).all()
    assert np.linalg.norm(found.normals, axis=1) == pytest.approx(1)


def test_features_tell_a_border_from_the_middle_of_a_plane():
    ticks = np.arange(15.0)
    x, y = np.meshgrid(ticks, ticks)
    plane = np.column_stack([x.ravel(), y.ravel(), np.zeros(225)])
    corner = 0
    middle = 7 * 15 + 7

    features = describe_neighbourhoods(plane).features

    beside = features[:, 4]  # distance from the mean of the six nearest points
    assert beside[corner] > beside[middle] + 1
