"""Weights of few vectors with the same weighted sum as many."""

import numpy as np
from numpy.typing import NDArray

Vectors = NDArray[np.float64]
Weights = NDArray[np.float64]

TINY = 1e-12
"""Part of the largest weight below which rounding has left a weight that should be 0."""


def same_sum(vectors: Vectors, keep: int) -> tuple[NDArray[np.int64], Weights]:
    """Choose a part of some vectors, with weights, of the same sum and the same sum of weights.

    A mean of vectors with d numbers is a weighted mean of d + 1 of them (Carathéodory). The vectors
    are put into twice as many clusters as are kept; the theorem applied to the means of the
    clusters leaves half of them, and so on (Maalouf, Jubran and Feldman, "Fast and Accurate
    Least-Mean-Squares Solvers", NeurIPS 2019).

    Args:
        vectors: ``(N, d)``.
        keep: number of vectors to keep, at least d + 1.

    Returns:
        Rows of vectors, ascending, at most ``keep``; their weights, above 0. The sum of the weights
        is N.
    """
    largest = np.abs(vectors).max(0, initial=0.0)
    divisors = np.where(largest > 0, largest, 1.0)
    scaled = vectors / divisors
    ones = np.ones(len(scaled))
    extended = np.column_stack([scaled, ones])
    rows = np.arange(len(extended))
    weights = np.ones(len(extended))
    while len(rows) > keep:
        number = min(len(rows), 2 * keep)
        clusters = np.array_split(np.arange(len(rows)), number)
        starts = np.array([cluster[0] for cluster in clusters])
        sizes = [len(cluster) for cluster in clusters]
        weighted = weights[:, None] * extended[rows]
        sums = np.add.reduceat(weighted, starts)
        factors = _reduced(sums, keep)
        weights *= np.repeat(factors, sizes)
        is_kept = weights > 0
        rows = rows[is_kept]
        weights = weights[is_kept]
    total = extended.sum(0)
    return rows, _corrected(extended[rows], weights, total)


def _reduced(vectors: Vectors, keep: int) -> Weights:
    """Return factors ``(K,)`` of vectors ``(K, D)`` with the same sum, at most ``keep`` above 0.

    A direction of the null space is added to the factors until one of them is 0. Then that factor
    is left out: a reflection of the orthonormal basis leaves all but one direction 0 there.
    """
    factors = np.ones(len(vectors))
    dimensions = vectors.shape[1]
    right = np.linalg.svd(vectors.T, full_matrices=True)[2]
    null = right[dimensions:]
    while len(null) and np.count_nonzero(factors) > keep:
        step = null[0]
        if step.max() <= 0:
            step = -step
        falls = (step > 0) & (factors > 0)
        lengths = np.full(len(factors), np.inf)
        lengths[falls] = factors[falls] / step[falls]
        first = int(lengths.argmin())
        moved = factors - lengths[first] * step
        factors = np.maximum(moved, 0.0)
        factors[first] = 0.0
        factors[factors < TINY * factors.max()] = 0.0
        null = _without(null, first)
    return factors


def _without(null: Vectors, column: int) -> Vectors:
    """Return a basis of those directions of an orthonormal one ``(L, K)`` that are 0 there."""
    mirror = null[:, column].copy()
    length = np.linalg.norm(mirror)
    mirror[0] += np.copysign(length, mirror[0])
    shares = 2 * (mirror @ null) / (mirror @ mirror)
    reflected = null - np.outer(mirror, shares)
    reflected[1:, column] = 0.0
    return reflected[1:]


def _corrected(vectors: Vectors, weights: Weights, total: Vectors) -> Weights:
    """Remove the rounding of the sum ``(D,)`` of weighted vectors, where weights stay above 0."""
    missing = total - weights @ vectors
    change = np.linalg.lstsq(vectors.T, missing, rcond=None)[0]
    corrected = weights + change
    if (corrected > 0).all():
        return corrected
    return weights
