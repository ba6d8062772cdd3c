"""Choices that hold a pose, beside plain forms of the same formulas."""

import numpy as np
import pytest

from mops_lightning.ops.normals import estimate_normals
from mops_lightning.ops.stability import (
    PRIOR,
    RIDGE,
    informative_places,
    places_by_direction,
    plane_rows,
    stable_places,
    steady_places,
)


def box(number, seed=0):
    """Points on the faces of a box, and some noise."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (number, 3)) * [3, 2, 1]
    axis = rng.integers(3, size=number)
    points[np.arange(number), axis] = rng.choice([-1, 1], number) * np.array([3, 2, 1])[axis]
    return points + rng.normal(0, 0.01, points.shape)


def plain_informative(rows, m):
    """Compute all log determinants anew for every choice."""
    matrix = PRIOR * np.eye(6)
    chosen: list[int] = []
    for _ in range(m):
        gains = [np.linalg.slogdet(matrix + np.outer(v, v))[1] for v in rows]
        gains = [-np.inf if place in chosen else gain for place, gain in enumerate(gains)]
        chosen.append(int(np.argmax(gains)))
        matrix += np.outer(rows[chosen[-1]], rows[chosen[-1]])
    return chosen


def plain_stable(rows, m):
    """Look through all points for every choice."""
    directions = np.linalg.eigh(rows.T @ rows)[1]
    squares = (rows @ directions) ** 2
    chosen: list[int] = []
    for _ in range(m):
        weakest = int(np.argmin(squares[chosen].sum(0)))
        left = [place for place in range(len(rows)) if place not in chosen]
        chosen.append(max(left, key=lambda place: squares[place, weakest]))
    return chosen


def plain_steady(rows, spread, m):
    """Compute the covariances of all poses anew for every choice."""
    variances = (spread / np.median(spread)) ** 2
    information = RIDGE * np.eye(6)
    noise = RIDGE * np.eye(6)
    chosen: list[int] = []
    for _ in range(m):
        traces = np.full(len(rows), np.inf)
        for place in set(range(len(rows))) - set(chosen):
            square = np.outer(rows[place], rows[place])
            inverse = np.linalg.inv(information + square)
            covariance = inverse @ (noise + variances[place] * square) @ inverse
            traces[place] = np.trace(covariance[:3, :3])  # of the rotation
        chosen.append(int(np.argmin(traces)))
        square = np.outer(rows[chosen[-1]], rows[chosen[-1]])
        information += square
        noise += variances[chosen[-1]] * square
    return chosen


def test_rows_are_the_changes_of_plane_distances_under_small_motions():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(20, 3))
    normals = estimate_normals(points)
    scale = np.linalg.norm(points - points.mean(0), axis=1).mean()
    turn, shift = np.array([1e-6, -2e-6, 3e-6]), np.array([2e-6, 1e-6, -1e-6])
    moved = points + np.cross(turn, points - points.mean(0)) + shift

    change = plane_rows(points, normals) @ np.concatenate([turn * scale, shift])

    assert change == pytest.approx(np.einsum("ni,ni->n", moved - points, normals), rel=1e-6)


def test_informative_places_equal_a_search_of_all_log_determinants():
    points = box(150)
    rows = plane_rows(points, estimate_normals(points))

    assert informative_places(rows, 40).tolist() == plain_informative(rows, 40)


def test_stable_places_equal_a_search_of_all_points():
    points = box(150)
    rows = plane_rows(points, estimate_normals(points))

    assert stable_places(rows, 40).tolist() == plain_stable(rows, 40)


def test_steady_places_equal_a_search_of_all_covariances():
    points = box(150)
    rows = plane_rows(points, estimate_normals(points))
    spread = np.random.default_rng(1).uniform(0.2, 3, 150)

    assert steady_places(rows, spread, 40).tolist() == plain_steady(rows, spread, 40)


def test_steady_places_leave_out_points_with_large_residuals():
    points = box(300)
    rows = plane_rows(points, estimate_normals(points))
    spread = np.where(np.arange(300) < 200, 1.0, 50.0)

    assert np.count_nonzero(steady_places(rows, spread, 40) >= 200) <= 1


def test_all_rules_return_every_place_once_when_all_points_are_kept():
    points = np.repeat(box(20), 3, axis=0)  # copies
    rows = plane_rows(points, estimate_normals(points))

    for places in (
        informative_places(rows, 60),
        stable_places(rows, 60),
        places_by_direction(rows[:, 3:], 60),
        steady_places(rows, np.ones(60), 60),
    ):
        assert sorted(places) == list(range(60))


def test_informative_and_stable_points_keep_the_step_that_holds_a_plane():
    """A floor slides in x and y and turns about z; only the points of a few steps prevent it."""
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-5, 5, (1000, 2)), np.zeros(1000)])
    wall = np.column_stack([np.full(15, 1.0), rng.uniform(-1, 1, 15), rng.uniform(0, 1, 15)])
    points = np.concatenate([floor, wall])
    normals = np.repeat([[0.0, 0, 1], [1.0, 0, 0]], [1000, 15], axis=0)
    rows = plane_rows(points, normals)

    for places in (informative_places(rows, 16), stable_places(rows, 16)):
        assert (places >= 1000).sum() >= 4


def test_directions_give_points_in_turn_and_opposite_normals_are_one_direction():
    up, side = [0.0, 0, 1], [1.0, 0, 0]
    down, tilted = [0.0, 0, -1], [0.6, 0, 0.8]
    normals = np.array([up, down, up, side, up, tilted, side])

    assert places_by_direction(normals, 7).tolist() == [0, 3, 5, 1, 6, 2, 4]


def test_directions_near_an_axis_share_a_cell_whatever_their_sign():
    rng = np.random.default_rng(0)
    normals = np.array([0.0, 0, 1]) + rng.uniform(-0.1, 0.1, (50, 3))
    normals *= rng.choice([-1, 1], (50, 1))

    assert places_by_direction(normals, 50).tolist() == list(range(50))
