"""Planes through neighbourhoods, in loops that numba compiles for ``ops.normals``."""

# mypy: disable-error-code="no-untyped-def"

import numpy as np

from mops_lightning.ops.jit import jit, jit_cached

SWEEPS = 12
"""Most sweeps of Jacobi's method; a matrix of three rows needs about five."""


@jit
def _rotate(matrix, vectors, p, q):
    """Make entry (p, q) of a symmetric 3×3 matrix 0 by a rotation, and turn the vectors with it."""
    if matrix[p, q] == 0.0:
        return
    difference = matrix[q, q] - matrix[p, p]
    half = difference / (2.0 * matrix[p, q])
    tangent = 1.0 / (abs(half) + np.sqrt(half * half + 1.0))
    if half < 0.0:
        tangent = -tangent
    cosine = 1.0 / np.sqrt(tangent * tangent + 1.0)
    sine = tangent * cosine
    for k in range(3):
        a = matrix[k, p]
        b = matrix[k, q]
        matrix[k, p] = cosine * a - sine * b
        matrix[k, q] = sine * a + cosine * b
    for k in range(3):
        a = matrix[p, k]
        b = matrix[q, k]
        matrix[p, k] = cosine * a - sine * b
        matrix[q, k] = sine * a + cosine * b
    for k in range(3):
        a = vectors[k, p]
        b = vectors[k, q]
        vectors[k, p] = cosine * a - sine * b
        vectors[k, q] = sine * a + cosine * b


@jit
def _smallest_axis(matrix, vectors):
    """Return the column of the eigenvector of the smallest eigenvalue; the matrix is changed."""
    vectors[:] = 0.0
    for k in range(3):
        vectors[k, k] = 1.0
    for _ in range(SWEEPS):
        rest = abs(matrix[0, 1]) + abs(matrix[0, 2]) + abs(matrix[1, 2])
        trace = matrix[0, 0] + matrix[1, 1] + matrix[2, 2]
        if rest <= 1e-17 * trace:
            break
        _rotate(matrix, vectors, 0, 1)
        _rotate(matrix, vectors, 0, 2)
        _rotate(matrix, vectors, 1, 2)
    smallest = 2  # of equal points: the z axis
    for k in range(2):
        if matrix[k, k] < matrix[smallest, smallest]:
            smallest = k
    return smallest


@jit
def _scatter(points, rows, mean, matrix):
    """Write the mean of points, and the sum of the products of their distances from it."""
    mean[:] = 0.0
    for j in range(len(rows)):
        for axis in range(3):
            mean[axis] += points[rows[j], axis]
    mean /= len(rows)
    matrix[:] = 0.0
    for j in range(len(rows)):
        row = rows[j]
        for a in range(3):
            along_a = points[row, a] - mean[a]
            for b in range(a, 3):
                along_b = points[row, b] - mean[b]
                matrix[a, b] += along_a * along_b
    for a in range(3):
        for b in range(a):
            matrix[a, b] = matrix[b, a]


@jit_cached
def plane_normals(points, neighbours):
    """Return the unit normal of the plane through the neighbours of every point.

    Args:
        points: ``(N, 3)`` float64.
        neighbours: ``(M, k)`` rows of points.

    Returns:
        ``(M, 3)``.
    """
    normals = np.empty((len(neighbours), 3))
    matrix = np.empty((3, 3))
    vectors = np.empty((3, 3))
    mean = np.empty(3)
    for i in range(len(neighbours)):
        _scatter(points, neighbours[i], mean, matrix)
        smallest = _smallest_axis(matrix, vectors)
        for axis in range(3):
            normals[i, axis] = vectors[axis, smallest]
    return normals


@jit_cached
def ellipsoids(points, neighbours):
    """Return the spread of the neighbours of every point, and where the point is in it.

    Args:
        points: ``(N, 3)`` float64.
        neighbours: ``(N, k)`` rows of points.

    Returns:
        ``(N, 5)``: the standard deviations along the three axes, ascending, and the point's
        distances from the neighbours' mean, across the shortest axis' plane and within it; and
        ``(N, 3)`` the directions of the shortest axes.
    """
    numbers = np.empty((len(neighbours), 5))
    normals = np.empty((len(neighbours), 3))
    matrix = np.empty((3, 3))
    vectors = np.empty((3, 3))
    mean = np.empty(3)
    lengths = np.empty(3)
    for i in range(len(neighbours)):
        _scatter(points, neighbours[i], mean, matrix)
        smallest = _smallest_axis(matrix, vectors)
        above = 0.0
        squared = 0.0
        for axis in range(3):
            variance = max(matrix[axis, axis], 0.0) / neighbours.shape[1]
            lengths[axis] = np.sqrt(variance)
            normals[i, axis] = vectors[axis, smallest]
            offset = points[i, axis] - mean[axis]
            above += offset * vectors[axis, smallest]
            squared += offset * offset
        lengths.sort()
        numbers[i, :3] = lengths
        numbers[i, 3] = abs(above)
        across = max(squared - above * above, 0.0)
        numbers[i, 4] = np.sqrt(across)
    return numbers, normals
