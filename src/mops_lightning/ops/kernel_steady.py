"""Choice of points for the smallest error of a pose, in a loop that numba compiles."""

# mypy: disable-error-code="no-untyped-def"

import numpy as np

from mops_lightning.ops.jit import jit, jit_cached


@jit
def _multiply(matrix, vector, into):
    """Write the product of a 6×6 matrix and a vector."""
    for a in range(6):
        total = 0.0
        for b in range(6):
            total += matrix[a, b] * vector[b]
        into[a] = total


@jit
def _inner(first, second):
    total = 0.0
    for a in range(6):
        total += first[a] * second[a]
    return total


@jit_cached
def grow_steady(rows, variances, weights, prior, m):
    """Choose m points, each of which lowers tr(D·H⁻¹·W·H⁻¹) most, or raises it least.

    H = prior·I + Σ v vᵀ and W = prior·I + Σ s² v vᵀ over the chosen points; D is diagonal. With
    g = H⁻¹v, u = g/(1 + vᵀg) and B = D·H⁻¹·W, another point changes the trace by
    −2uᵀB g + (gᵀW g + s²)·uᵀD u (Sherman and Morrison).

    Args:
        rows: ``(N, 6)`` the vectors v.
        variances: ``(N,)`` the squares s².
        weights: ``(6,)`` the diagonal of D.
        prior: above 0.
        m: number of points.

    Returns:
        ``(m,)`` places, in the order of choice; of equal changes the lowest place.
    """
    inverse = np.eye(6) / prior
    noise = np.eye(6) * prior
    taken = np.zeros(len(rows), np.bool_)
    chosen = np.empty(m, np.int64)
    sandwich = np.empty((6, 6))
    lever = np.empty(6)
    product = np.empty(6)
    for step in range(m):
        for a in range(6):
            for b in range(6):
                total = 0.0
                for c in range(6):
                    total += inverse[a, c] * noise[c, b]
                sandwich[a, b] = weights[a] * total
        best = np.inf
        place = -1
        for i in range(len(rows)):
            if taken[i]:
                continue
            _multiply(inverse, rows[i], lever)
            share = 1.0 / (1.0 + _inner(rows[i], lever))
            _multiply(sandwich, lever, product)
            gained = 2.0 * share * _inner(lever, product)
            _multiply(noise, lever, product)
            spread = _inner(lever, product) + variances[i]
            moved = 0.0
            for a in range(6):
                moved += weights[a] * lever[a] * lever[a]
            change = share * share * spread * moved - gained
            if change < best:
                best = change
                place = i
        taken[place] = True
        chosen[step] = place
        _multiply(inverse, rows[place], lever)
        share = 1.0 / (1.0 + _inner(rows[place], lever))
        for a in range(6):
            for b in range(6):
                inverse[a, b] -= share * lever[a] * lever[b]
                noise[a, b] += variances[place] * rows[place, a] * rows[place, b]
    return chosen
