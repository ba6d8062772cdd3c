"""Rays on triangles: a plain twin, and edges that two triangles share."""

import numpy as np
import pytest
import trimesh

from mops_lightning.data.procedural import rays
from mops_lightning.data.procedural.rays import NOTHING, Camera, RayGrid, nearest_faces


@pytest.fixture
def camera():
    return Camera.looking_at(np.array([0.0, 0.1, 0.0]), np.array([2.0, 1.0, 1.5]))


@pytest.fixture
def triangles(camera):
    """A ball, which hides a part of the box behind it, in the axes of the camera."""
    ball = trimesh.creation.icosphere(2, 0.4)
    box = trimesh.creation.box((0.5, 0.5, 2.0))
    box.apply_translation((-1.0, 0, 0))
    return camera.seen(np.concatenate([ball.triangles, box.triangles]))


def one_ray(triangles, direction):
    """The twin: solve place = distance · direction for every triangle in turn."""
    nearest = (np.inf, NOTHING)
    for row, (first, second, third) in enumerate(triangles):
        system = np.column_stack((second - first, third - first, -direction))
        if abs(np.linalg.det(system)) < 1e-12:
            continue
        along_second, along_third, depth = np.linalg.solve(system, -first)
        if along_second >= 0 and along_third >= 0 and along_second + along_third <= 1:
            nearest = min(nearest, (depth, row))
    return nearest


def test_nearest_faces_are_those_of_one_ray_after_the_other(triangles):
    grid = RayGrid.around(triangles.reshape(-1, 3), 12, np.array([0.3, 0.6]))

    depths, faces = nearest_faces(triangles, grid)

    expected = [one_ray(triangles, direction) for direction in grid.directions]
    assert faces.tolist() == [face for _, face in expected]
    assert depths == pytest.approx([depth for depth, _ in expected])
    assert 20 < (faces != NOTHING).sum() < 144


def test_nearest_faces_in_groups_are_those_at_once(triangles, monkeypatch):
    grid = RayGrid.around(triangles.reshape(-1, 3), 30, np.array([0.5, 0.5]))
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
    grid = RayGrid(across=np.array([0.0, 0.25]), up=np.array([0.0, 0.25]))

    depths, faces = nearest_faces(square, grid)

    assert depths.tolist() == [2, 2, 2, 2]
    assert (faces != NOTHING).all()


def test_nearest_faces_miss_what_is_beside_the_grid():
    triangle = np.array([[[5, 5, 1], [6, 5, 1], [5, 6, 1]]], float)
    grid = RayGrid(across=np.linspace(-1, 1, 3), up=np.linspace(-1, 1, 3))

    depths, faces = nearest_faces(triangle, grid)

    assert np.isinf(depths).all()
    assert faces.tolist() == [NOTHING] * 9


def test_camera_turns_points_there_and_back(camera):
    points = np.random.default_rng(0).normal(size=(20, 3))

    seen = camera.seen(points)

    assert camera.world(seen) == pytest.approx(points)
    assert camera.axes @ camera.axes.T == pytest.approx(np.eye(3))
    assert camera.seen(np.array([0.0, 0.1, 0.0]))[:2] == pytest.approx([0, 0])
    assert camera.axes[1] @ (0, 1, 0) > 0
