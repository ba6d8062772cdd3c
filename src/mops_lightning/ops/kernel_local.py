"""Columns with few entries and sums of chosen rows, compiled by numba for ``ops.local_attention``.

All clouds of a batch are in one call, because a call with arrays takes 20 µs from Python.
"""

# mypy: disable-error-code="no-untyped-def"

import math

import numpy as np

from mops_lightning.ops.jit import jit_sums

AT_ONCE = 4
"""Number of rows that are added at once, so that sums are read and written less often."""


@jit_sums
def columns(queries, keys, points, sharpness, anchors, places, tau, weights):
    """Write the columns of S: the softmax over t of (⟨q, h⟩ − sharpness · |p − a|²)/τ.

    Args:
        queries: ``(B, M, C)`` vectors q.
        keys: ``(B, K, C)`` vectors h of the candidates.
        points: ``(B, K, 3)`` the candidates p.
        sharpness: ``(B, M)``.
        anchors: ``(B, M)`` the place of every anchor a among the candidates.
        places: ``(B, M, k)`` the candidates of every column.
        tau: the temperature τ.
        weights: ``(B, M, k)``, where to write.
    """
    clouds, m, k = weights.shape
    rate = weights.dtype.type(1 / tau)
    for cloud in range(clouds):
        for j in range(m):
            query, anchor = queries[cloud, j], points[cloud, anchors[cloud, j]]
            line = weights[cloud, j]
            top = weights.dtype.type(-np.inf)
            for t in range(k):
                place = places[cloud, j, t]
                key, point = keys[cloud, place], points[cloud, place]
                product = weights.dtype.type(0)
                for c in range(len(query)):
                    product += query[c] * key[c]
                square = weights.dtype.type(0)
                for axis in range(len(point)):
                    apart = point[axis] - anchor[axis]
                    square += apart * apart
                line[t] = (product - sharpness[cloud, j] * square) * rate
                top = max(top, line[t])
            total = weights.dtype.type(0)
            for t in range(k):
                line[t] = math.exp(line[t] - top)
                total += line[t]
            for t in range(k):
                line[t] /= total


@jit_sums
def columns_backward(
    gradients,
    weights,
    queries,
    keys,
    points,
    sharpness,
    anchors,
    places,
    tau,
    query_gradients,
    key_gradients,
    point_gradients,
    sharpness_gradients,
):
    """Add the gradients of ``columns`` to the gradients of its arguments.

    Those of the points are left out where their array is empty.
    """
    clouds, m, k = weights.shape
    rate = weights.dtype.type(1 / tau)
    given = np.empty(k, weights.dtype)  # the gradients of the logits of a column
    are_points_fixed = point_gradients.size == 0
    for cloud in range(clouds):
        for j in range(m):
            mean = weights.dtype.type(0)
            for t in range(k):
                mean += weights[cloud, j, t] * gradients[cloud, j, t]
            for t in range(k):
                given[t] = weights[cloud, j, t] * (gradients[cloud, j, t] - mean) * rate
            query, query_gradient = queries[cloud, j], query_gradients[cloud, j]
            for t in range(k):
                key = keys[cloud, places[cloud, j, t]]
                for c in range(len(query)):
                    query_gradient[c] += given[t] * key[c]
            for t in range(k):
                key_gradient = key_gradients[cloud, places[cloud, j, t]]
                for c in range(len(query)):
                    key_gradient[c] += given[t] * query[c]
            factor = weights.dtype.type(-2) * sharpness[cloud, j]
            anchor = anchors[cloud, j]
            ax, ay, az = (
                points[cloud, anchor, 0],
                points[cloud, anchor, 1],
                points[cloud, anchor, 2],
            )
            gx = gy = gz = total = weights.dtype.type(0)
            for t in range(k):
                place, share = places[cloud, j, t], factor * given[t]
                x = points[cloud, place, 0] - ax
                y = points[cloud, place, 1] - ay
                z = points[cloud, place, 2] - az
                total += given[t] * (x * x + y * y + z * z)
                if are_points_fixed:
                    continue
                point_gradients[cloud, place, 0] += share * x
                point_gradients[cloud, place, 1] += share * y
                point_gradients[cloud, place, 2] += share * z
                gx, gy, gz = gx + share * x, gy + share * y, gz + share * z
            sharpness_gradients[cloud, j] -= total
            if are_points_fixed:
                continue
            point_gradients[cloud, anchor, 0] -= gx
            point_gradients[cloud, anchor, 1] -= gy
            point_gradients[cloud, anchor, 2] -= gz


@jit_sums
def sums(weights, rows, values, out):
    """Write the sum of ``weights[b, j, t] · values[b, rows[b, j, t]]`` over t to ``out[b, j]``."""
    clouds, m, k = weights.shape
    channels = values.shape[2]
    whole = k // AT_ONCE * AT_ONCE
    for cloud in range(clouds):
        cloud_values = values[cloud]
        for j in range(m):
            total, weight, row = out[cloud, j], weights[cloud, j], rows[cloud, j]
            for c in range(channels):
                total[c] = 0
            for t in range(0, whole, AT_ONCE):
                w0, w1, w2, w3 = weight[t], weight[t + 1], weight[t + 2], weight[t + 3]
                line0, line1 = cloud_values[row[t]], cloud_values[row[t + 1]]
                line2, line3 = cloud_values[row[t + 2]], cloud_values[row[t + 3]]
                for c in range(channels):
                    total[c] += w0 * line0[c] + w1 * line1[c] + w2 * line2[c] + w3 * line3[c]
            for t in range(whole, k):
                line0 = cloud_values[row[t]]
                for c in range(channels):
                    total[c] += weight[t] * line0[c]


@jit_sums
def sums_backward(gradients, weights, rows, values, weight_gradients, value_gradients):
    """Add the gradients of ``sums`` to those of values, and write those of weights.

    Those of the values are left out where their array is empty.
    """
    clouds, m, k = weights.shape
    are_values_fixed = value_gradients.size == 0
    for cloud in range(clouds):
        for j in range(m):
            gradient = gradients[cloud, j]
            for t in range(k):
                weight = weights[cloud, j, t]
                line = values[cloud, rows[cloud, j, t]]
                product = weights.dtype.type(0)
                for c in range(len(gradient)):
                    product += gradient[c] * line[c]
                weight_gradients[cloud, j, t] = product
                if are_values_fixed:
                    continue
                line_gradient = value_gradients[cloud, rows[cloud, j, t]]
                for c in range(len(gradient)):
                    line_gradient[c] += weight * gradient[c]
