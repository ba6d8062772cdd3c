"""Rays on triangles: a plain twin, and edges that two triangles share."""

import numpy as np
import pytest
import trimesh

from mops_lightning.data.procedural import rays
from mops_lightning.data.procedural.rays import NOTHING, Camera, RayGrid, nearest_faces
from tests.support.clouds import normal_points


@pytest.fixture
def camera():
    aim = np.array([0.0, 0.1, 0.0])
    place = np.array([2.0, 1.0, 1.5])
    return Camera.looking_at(aim, place)


@pytest.fixture
def triangles(camera):
    """A ball, which hides a part of the box behind it, in the axes of the camera."""
    ball = trimesh.creation.icosphere(2, 0.4)
    box = trimesh.creation.box((0.5, 0.5, 2.0))
    box.apply_translation((-1.0, 0, 0))
    both = np.concatenate([ball.triangles, box.triangles])
    return camera.seen(both)


def one_ray(triangles, direction):
    """The twin: solve place = distance · direction for every triangle in turn."""
    nearest = (np.inf, NOTHING)
    for row, (first, second, third) in enumerate(triangles):
        system = np.column_stack((second - first, third - first, -direction))
        if abs(np.linalg.det(system)) < 1e-12:
            continue
        along_second, along_third, depth = np.linalg.solve(system, -first)
        is_inside = min(along_second, along_third, 1 - along_second - along_third) >= 0
        if is_inside:
            nearest = min(nearest, (depth, row))
    return nearest


def test_nearest_faces_are_those_of_one_ray_after_the_other(triangles):
    corners = triangles.reshape(-1, 3)
    grid = RayGrid.around(corners, 12, np.array([0.3, 0.6]))

    depths, faces = nearest_faces(triangles, grid)

    expected_depths = []
    expected_faces = []
    for direction in grid.directions:
        depth, face = one_ray(triangles, direction)
        expected_depths.append(depth)
        expected_faces.append(face)
    assert faces.tolist() == expected_faces
    assert depths == pytest.approx(expected_depths)
    hits = (faces != NOTHING).sum()
    assert 20 < hits < 144


def test_nearest_faces_in_groups_are_those_at_once(triangles, monkeypatch):
    corners = triangles.reshape(-1, 3)
    grid = RayGrid.around(corners, 30, np.array([0.5, 0.5]))
    depths, faces = nearest_faces(triangles, grid)
    monkeypatch.setattr(rays, "MOST_PAIRS", 10)

    again, faces_again = nearest_faces(triangles, grid)

    assert np.array_equal(again, depths)
    assert np.array_equal(faces_again, faces)


def test_nearest_faces_ray_on_a_shared_edge_meets_a_triangle():
    square = np.array(
        [
            [[-1, -1, 2], [1, -1, 2], [1, 1, 2]],
            [[-1, -1, 2], [1, 1, 2], [-1, 1, 2]],
        ],
        float,
    )
    ticks = np.array([0.0, 0.25])
    grid = RayGrid(across=ticks, up=ticks)

    depths, faces = nearest_faces(square, grid)

    assert depths.tolist() == [2, 2, 2, 2]
    assert (faces != NOTHING).all()


def test_nearest_faces_miss_what_is_beside_the_grid():
    triangle = np.array(
        [
            [5.0, 5.0, 1.0],
            [6.0, 5.0, 1.0],
            [5.0, 6.0, 1.0],
        ]
    )
    ticks = np.array([-1.0, 0.0, 1.0])
    grid = RayGrid(across=ticks, up=ticks)

    depths, faces = nearest_faces(triangle[None], grid)

    assert np.isinf(depths).all()
    assert faces.tolist() == [NOTHING] * 9


def test_camera_turns_points_there_and_back(camera):
    points = normal_points(20, 0)

    seen = camera.seen(points)
    back = camera.world(seen)

    assert back == pytest.approx(points)


def test_camera_has_orthonormal_axes_and_sees_its_aim_in_the_middle_and_upright(camera):
    aim = np.array([0.0, 0.1, 0.0])

    x, y, _ = camera.seen(aim)

    products = camera.axes @ camera.axes.T
    assert products == pytest.approx(np.eye(3))
    assert x == pytest.approx(0)
    assert y == pytest.approx(0)
    _, up, _ = camera.axes
    assert up[1] > 0
