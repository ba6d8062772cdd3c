"""Assignments against brute force, and the sizes of the exact problems that a round solves."""

import numpy as np
import ot
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from mops_lightning.ops import assignment
from mops_lightning.ops.assignment import approximate_assignment, solve_assignment

RECORDED = [218.255914, 210.018198, 208.054227, 207.526908, 206.56343]
"""Costs of ``clouds(200)`` after 0 to 4 rounds: distances in committed records depend on them."""


def clouds(n, seed=0):
    rng = np.random.default_rng(seed)
    p = rng.normal(size=(n, 3))
    q = rng.normal(size=(n, 3))
    return p, q * [1, 2, 0.5]


def cost(p, q, rows):
    return np.linalg.norm(p - q[rows], axis=1).sum()


@pytest.fixture
def solved(monkeypatch):
    """Return a list of the exact problems that are solved: the points of both clouds."""
    problems = []

    def recorded(p, q):
        problems.append((p, q))
        return solve_assignment(p, q)

    monkeypatch.setattr(assignment, "solve_assignment", recorded)
    return problems


@pytest.mark.parametrize("limit", [1, 10**9])
def test_solve_by_either_solver_is_exact(limit, monkeypatch):
    monkeypatch.setattr(assignment, "NETWORK_SIMPLEX_MIN_POINTS", limit)
    p, q = clouds(70)

    rows = solve_assignment(p, q)

    _, expected = linear_sum_assignment(cdist(p, q))
    assert rows.dtype == np.int64
    assert np.array_equal(rows, expected)


def test_solve_of_plan_that_is_no_bijection_is_exact(monkeypatch):
    monkeypatch.setattr(assignment, "NETWORK_SIMPLEX_MIN_POINTS", 1)
    monkeypatch.setattr(ot, "emd", lambda a, b, cost, **_: np.ones_like(cost))
    p, q = clouds(20)

    rows = solve_assignment(p, q)

    _, expected = linear_sum_assignment(cdist(p, q))
    assert np.array_equal(rows, expected)


@pytest.mark.parametrize(
    ("n", "sizes"),
    [
        (64, [16, 16, 16, 16]),
        (70, [8, 8, 9, 9, 9, 9, 9, 9]),
    ],
)
@pytest.mark.parametrize("rounds", [1, 2, 3])
def test_approximate_solves_blocks_that_cover_all_points_in_every_round(n, sizes, rounds, solved):
    p, q = clouds(n)
    number = len(sizes)

    rows = approximate_assignment(p, q, 16, rounds)

    assert sorted(rows.tolist()) == list(range(n))
    assert len(solved) == number * (rounds + 1)
    for start in range(0, len(solved), number):
        blocks = solved[start : start + number]
        assert sorted(len(block) for block, _ in blocks) == sizes
        joined_p = np.concatenate([block for block, _ in blocks])
        joined_q = np.concatenate([block for _, block in blocks])
        assert np.array_equal(np.sort(joined_p, 0), np.sort(p, 0))
        assert np.array_equal(np.sort(joined_q, 0), np.sort(q, 0))


def test_approximate_cost_never_increases_and_is_fixed():
    p, q = clouds(200)

    costs = []
    for rounds in range(5):
        rows = approximate_assignment(p, q, 32, rounds)
        costs.append(cost(p, q, rows))

    assert costs == sorted(costs, reverse=True)
    assert costs == pytest.approx(RECORDED, rel=1e-6)


def test_approximate_in_one_block_is_exact(solved):
    p, q = clouds(40)

    rows = approximate_assignment(p, q, 40, 5)

    assert len(solved) == 1
    assert np.array_equal(rows, solve_assignment(p, q))
