"""The error of a pose."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mops_lightning.files.icp.align import (
    align,
    pose_difference,
    prepare_source,
    prepare_target,
    small_gicp,
    timed_error,
)
from mops_lightning.files.icp.measure import Setup, compare_by_icp
from mops_lightning.files.icp.pairs import Pair, draw_motions
from mops_lightning.seeding import derive_seed
from tests.support.clouds import uniform_points

CENTRE = np.array([1000.0, 0.0, 5.0])
"""A scan far from the origin."""


def test_pose_difference_is_the_shift_of_the_centre_not_of_the_origin():
    rotation = Rotation.from_euler("z", 2, degrees=True).as_matrix()
    truth = np.eye(4)
    found = np.eye(4)
    found[:3, :3] = rotation
    found[:3, 3] = CENTRE - rotation @ CENTRE + [0.0, 0.3, 0.4]

    degrees, shift = pose_difference(found, truth, CENTRE)

    assert degrees == pytest.approx(2.0)
    assert shift == pytest.approx(0.5)


def test_align_takes_no_correspondences_beyond_the_largest_distance():
    points = uniform_points(300, 0)
    target = prepare_target(points)
    source = prepare_source(points, "gicp")
    start = np.eye(4)
    start[0, 3] = 0.05

    near = align(target, source, start, "gicp", max_distance=1e-6)
    far = align(target, source, start, "gicp", max_distance=0.5)

    assert near == pytest.approx(start)
    assert far == pytest.approx(np.eye(4), abs=1e-3)


def test_source_has_covariances_of_planes_for_gicp():
    points = uniform_points(50, 0)

    covariances = np.stack(prepare_source(points, "gicp").covs())

    # small_gicp sets the variances to 1 along the plane, and to 0.001 across it.
    variances = np.linalg.eigvalsh(covariances[:, :3, :3])
    assert variances == pytest.approx(np.tile([0.001, 1, 1], (50, 1)))


def test_target_has_the_normals_of_twelve_neighbours():
    points = uniform_points(60, 0)

    normals = prepare_target(points).cloud.normals()[:, :3]

    distances = np.linalg.norm(points[:, None] - points, axis=2)
    for row, normal in enumerate(normals):
        near = points[distances[row].argsort()[:12]]
        values, axes = np.linalg.eigh(np.cov(near.T))
        assert abs(axes[:, 0] @ normal) == pytest.approx(1, abs=1e-3)


def test_align_goes_on_until_the_pose_no_longer_changes():
    points = uniform_points(500, 0) * [4, 3, 2]
    target = prepare_target(points)
    turn = Rotation.from_euler("xyz", [12, -9, 14], degrees=True).as_matrix()
    start = np.eye(4)
    start[:3, :3] = turn

    found = align(target, prepare_source(points, "gicp"), start, "gicp", max_distance=3.0)

    degrees, shift = pose_difference(found, np.eye(4), points.mean(0))
    assert degrees < 0.01
    assert shift < 1e-3


def test_registrations_are_those_of_their_names():
    points = uniform_points(300, 0) * [1, 1, 0.3]
    target = prepare_target(points[::2])
    source = prepare_source(points[1::2], "gicp")

    by_plane = align(target, source, np.eye(4), "plane", max_distance=0.5)
    by_gicp = align(target, source, np.eye(4), "gicp", max_distance=0.5)

    expected = {}
    for name in ("PLANE_ICP", "GICP"):
        result = small_gicp().align(
            target.cloud,
            source,
            target.tree,
            registration_type=name,
            max_correspondence_distance=0.5,
            max_iterations=200,
            rotation_epsilon=1e-6,
            translation_epsilon=1e-6,
        )
        expected[name] = result.T_target_source
    assert by_plane == pytest.approx(expected["PLANE_ICP"], abs=1e-3)
    assert by_gicp == pytest.approx(expected["GICP"], abs=1e-3)
    assert not np.allclose(by_plane, by_gicp, atol=1e-2)


def test_score_is_the_median_over_all_starts():
    points = uniform_points(400, 0) * [1, 1, 0.2]
    pair = Pair(Path("scan.ply"), points[::2], points[1::2], np.eye(4))
    setup = Setup(
        sizes=[],
        methods=[],
        registrations=["plane"],
        draws=1,
        motions=5,
        angle=90.0,
        shift=0.5,
        max_distance=0.3,
        is_target_sampled=False,
        seed=0,
    )

    (score,) = compare_by_icp(lambda draw: [pair], setup)

    (starts,) = draw_motions([pair], 5, 90.0, 0.5, derive_seed(0, 0))
    target = prepare_target(pair.target)
    source = prepare_source(pair.source, "plane")
    centre = pair.source.mean(0)
    errors = [
        timed_error(target, source, start, "plane", 0.3, truth=np.eye(4), centre=centre)
        for start in starts
    ]
    degrees = sorted(error.degrees for error in errors)
    shifts = sorted(error.shift for error in errors)
    assert score.degrees == degrees[2]
    assert score.shift == shifts[2]
    assert score.aligned == np.mean(np.array(degrees) < 2)
    assert (score.points, score.pairs, score.m) == (200, 5, 0)
