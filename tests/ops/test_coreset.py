"""Exact coresets of point-to-plane residuals."""

from typing import NamedTuple

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mops_lightning import coreset
from mops_lightning.errors import UserError
from mops_lightning.ops.caratheodory import same_sum
from mops_lightning.ops.normals import estimate_normals


def surface(number, seed):
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-3, 3, (2, number))
    noise = rng.normal(0, 0.02, number)
    height = np.sin(x) + np.cos(2 * y) / 2
    z = height + noise
    return np.stack([x, y, z], 1)


class Sums(NamedTuple):
    """What residuals add up to: H, b and the error."""

    hessian: np.ndarray
    slope: np.ndarray
    error: float


def pose_of(turn, shift):
    rotation = Rotation.from_rotvec(turn)
    pose = np.eye(4)
    pose[:3, :3] = rotation.as_matrix()
    pose[:3, 3] = shift
    return pose


def plain_sums(source, target, pose, rows, weights):
    """Add up H, b and the error, residual by residual, about the origin of the target."""
    normals = estimate_normals(target)
    tree = cKDTree(target)
    rotation = pose[:3, :3]
    shift = pose[:3, 3]
    hessian = np.zeros((6, 6))
    slope = np.zeros(6)
    error = 0.0
    for row, weight in zip(rows, weights, strict=True):
        moved = rotation @ source[row] + shift
        _, nearest = tree.query(moved)
        normal = normals[nearest]
        offset = moved - target[nearest]
        residual = normal @ offset
        by_turn = np.cross(moved, normal)
        jacobian = np.concatenate([by_turn, normal])
        hessian += weight * np.outer(jacobian, jacobian)
        slope += weight * jacobian * residual
        error += weight * residual**2
    return Sums(hessian, slope, error)


def plain_sums_of_all(source, target, pose):
    """Add up the residuals of all source points, each with a weight of 1."""
    rows = range(len(source))
    weights = np.ones(len(source))
    return plain_sums(source, target, pose, rows, weights)


def assert_equal_sums(kept, whole):
    """Compare each sum up to rounding, relative to its largest number."""
    for of_kept, of_whole in zip(kept, whole, strict=True):
        largest = np.abs(of_whole).max()
        tolerance = 1e-9 * largest
        assert of_kept == pytest.approx(of_whole, rel=1e-9, abs=tolerance)


@pytest.mark.parametrize("m", [29, 40, 100, 300])
def test_coreset_has_the_sums_of_all_residuals(m):
    source = surface(1500, 0)
    target = surface(1200, 1)
    pose = pose_of([0.05, -0.1, 0.2], [0.1, 0.2, -0.1])

    rows, weights = coreset(source, target, pose, m)

    of_all = plain_sums_of_all(source, target, pose)
    of_kept = plain_sums(source, target, pose, rows, weights)
    distinct = np.unique(rows)
    assert_equal_sums(of_kept, of_all)
    assert len(rows) == m
    assert len(distinct) == len(rows)
    assert (weights > 0).all()
    assert weights.sum() == pytest.approx(1500, rel=1e-9)


def test_coreset_gives_the_gauss_newton_step_of_all_points_in_map_coordinates():
    origin = np.array([4e5, 5e6, 100.0])
    source = surface(1500, 0)
    target = surface(1200, 1) + origin
    turn = [0.05, -0.1, 0.2]
    shift = np.array([0.1, 0.2, -0.1])
    pose = pose_of(turn, origin + shift)

    rows, weights = coreset(source, target, pose, 29)

    near_pose = pose_of(turn, shift)
    near_target = target - origin
    of_all = plain_sums_of_all(source, near_target, near_pose)
    of_kept = plain_sums(source, near_target, near_pose, rows, weights)
    step_of_all = np.linalg.solve(of_all.hessian, of_all.slope)
    step = np.linalg.solve(of_kept.hessian, of_kept.slope)
    assert step == pytest.approx(step_of_all, rel=1e-7)


def test_coreset_of_a_plane_has_its_sums_though_its_hessian_is_singular():
    rng = np.random.default_rng(0)
    flat = np.zeros((800, 3))
    flat[:, :2] = rng.uniform(-1, 1, (800, 2))
    source = flat[:400]
    target = flat[400:]
    pose = pose_of([0.01, 0, 0], [0, 0, 0.1])

    rows, weights = coreset(source, target, pose, 29)

    of_all = plain_sums_of_all(source, target, pose)
    of_kept = plain_sums(source, target, pose, rows, weights)
    assert_equal_sums(of_kept, of_all)


def test_coreset_takes_tensors_normals_and_leaves_out_far_points():
    source = surface(300, 0)
    source[:100] += 50.0
    source_tensor = torch.from_numpy(source)
    target = surface(300, 1)
    pose = torch.eye(4)
    up = [0.0, 0.0, 1.0]
    normals = np.tile(up, (300, 1))

    rows, weights = coreset(source_tensor, target, pose, 40, normals=normals, max_distance=1.0)

    assert rows.min() >= 100
    assert weights.sum() == pytest.approx(200)


@pytest.mark.parametrize("m", [np.int64(40), np.uint8(40), torch.tensor(40)])
def test_coreset_takes_whole_numbers_of_numpy_and_torch(m):
    source = surface(100, 0)
    target = surface(100, 1)
    pose = np.eye(4)

    rows, weights = coreset(source, target, pose, m)

    expected = coreset(source, target, pose, 40)
    assert rows.tolist() == expected.rows.tolist()
    assert weights.tolist() == expected.weights.tolist()


def test_coreset_takes_lists_half_precision_and_a_distance_in_a_tensor():
    points = surface(50, 0)
    source = torch.from_numpy(points).bfloat16()
    target = surface(50, 1)
    pose = np.eye(4)
    target_list = target.tolist()
    pose_list = pose.tolist()
    distance = torch.tensor(2.0)

    rows, _ = coreset(source, target_list, pose_list, 50, max_distance=distance)

    rounded = source.double().numpy()
    in_arrays = coreset(rounded, target, pose, 50, max_distance=2.0)
    assert rows.tolist() == in_arrays.rows.tolist()


def test_coreset_returns_all_points_where_there_are_few():
    points = surface(25, 0)
    pose = np.eye(4)

    rows, weights = coreset(points, points, pose, 29)

    assert rows.tolist() == list(range(25))
    assert weights.tolist() == [1.0] * 25


def test_same_sum_of_numbers_on_a_line_is_two_of_them():
    numbers = np.arange(100.0)
    vectors = numbers[:, None]

    rows, weights = same_sum(vectors, 2)

    total = weights @ numbers[rows]
    assert len(rows) <= 2
    assert weights.sum() == pytest.approx(100)
    assert total == pytest.approx(4950)


@pytest.mark.parametrize("keep", [5, 12, 100])
def test_same_sum_is_exact_for_numbers_of_very_different_sizes(keep):
    numbers = np.random.default_rng(4).uniform(1, 2, (500, 4))
    vectors = numbers * [1e-12, 1.0, 1e12, 1e-3]

    rows, weights = same_sum(vectors, keep)

    assert 0 < len(rows) <= keep
    assert (np.diff(rows) > 0).all()
    assert (weights > 0).all()
    assert weights.sum() == pytest.approx(500, rel=1e-9)
    np.testing.assert_allclose(weights @ vectors[rows], vectors.sum(0), rtol=1e-9)


UNKNOWN_SHIFT = pose_of([0, 0, 0], [0, np.nan, 0])


@pytest.mark.parametrize(
    ("argument", "value", "message"),
    [
        ("m", 28, "m must be a whole number of at least 29, got 28"),
        ("m", 29.0, "m must be a whole number of at least 29, got 29.0"),
        ("m", np.float64(29), "m must be a whole number of at least 29"),
        ("m", True, "m must be a whole number of at least 29, got True"),
        ("source", np.zeros((5, 2)), r"source must have shape \(N, 3\).* got \(5, 2\)"),
        ("target", np.full((5, 3), np.nan), "target must be finite"),
        ("target", np.ones((5, 3), complex), r"target must be numbers \(N, 3\)"),
        ("pose", np.eye(3), r"pose must be a \(4, 4\) rigid motion, got shape \(3, 3\)"),
        ("pose", "poses.txt", r"pose must be numbers \(4, 4\), got str"),
        ("pose", [[1, 2], [3]], r"pose must be numbers \(4, 4\), got list"),
        ("pose", {}, r"pose must be numbers \(4, 4\), got dict"),
        ("pose", UNKNOWN_SHIFT, "pose must be finite, got NaN"),
        ("pose", 2 * np.eye(4), r"pose must be a \(4, 4\) rigid motion"),
        ("pose", np.diag([1.0, 1.0, -1.0, 1.0]), "a rotation and a shift, with .* below"),
        ("pose", np.diag([1.0, 1.0, 1.0, 2.0]), "a rotation and a shift, with .* below"),
        ("normals", np.ones((4, 3)), r"normals must be one per target point, \(50, 3\)"),
        ("max_distance", 0.0, "max_distance must be a number above 0, got 0.0"),
        ("max_distance", None, "max_distance must be a number above 0, got None"),
        ("max_distance", "far", "max_distance must be a number above 0, got 'far'"),
        ("max_distance", np.nan, "max_distance must be a number above 0, got nan"),
    ],
)
def test_coreset_names_a_wrong_argument(argument, value, message):
    arguments = {
        "source": surface(50, 0),
        "target": surface(50, 1),
        "pose": np.eye(4),
        "m": 29,
    }
    arguments[argument] = value

    with pytest.raises(UserError, match=message):
        coreset(**arguments)


def test_coreset_of_points_that_are_all_far_away_is_refused():
    source = surface(50, 0)
    target = surface(50, 1)
    far = pose_of([0, 0, 0], [99, 0, 0])

    with pytest.raises(UserError, match="no source point is"):
        coreset(source, target, far, 29, max_distance=1.0)


@pytest.mark.parametrize("size", [1e100, 1e200])
def test_coreset_of_sums_too_large_for_float64_is_refused(size):
    source = surface(100, 0)
    target = surface(100, 1)
    pose = np.eye(4)
    normals = np.zeros((100, 3))
    normals[:, 2] = size

    with pytest.raises(UserError, match="too large for float64"):
        coreset(source, target, pose, 29, normals=normals)


def test_coreset_has_residuals_of_points_as_far_as_the_largest_distance():
    target = np.zeros((1, 3))
    source = np.zeros((3, 3))
    source[:, 2] = [1.0, 2.0, 2.25]
    normal = np.array([[0.0, 0.0, 1.0]])

    rows, weights = coreset(source, target, np.eye(4), 29, normals=normal, max_distance=2.0)

    assert rows.tolist() == [0, 1]
    assert weights.tolist() == [1.0, 1.0]
