"""Products with chosen rows and sums of them, compiled by numba for ``ops.local_attention``."""

# mypy: disable-error-code="no-untyped-def"

from mops_lightning.ops.jit import jit_cached, jit_sums


@jit_sums
def products(queries, keys, places, out):
    """Write ⟨queries[i], keys[places[i, t]]⟩ to ``out[i, t]``."""
    for i in range(len(queries)):
        query = queries[i]
        for t in range(places.shape[1]):
            key = keys[places[i, t]]
            total = queries.dtype.type(0)
            for c in range(len(query)):
                total += query[c] * key[c]
            out[i, t] = total


@jit_cached
def products_backward(gradients, queries, keys, places, query_gradients, key_gradients):
    """Add the gradients of ``products`` to those of queries and keys."""
    channels = queries.shape[1]
    for i in range(len(queries)):
        query, query_gradient = queries[i], query_gradients[i]
        for t in range(places.shape[1]):
            gradient = gradients[i, t]
            key, key_gradient = keys[places[i, t]], key_gradients[places[i, t]]
            for c in range(channels):
                query_gradient[c] += gradient * key[c]
                key_gradient[c] += gradient * query[c]


@jit_cached
def sums(weights, rows, values, out):
    """Write the sum of ``weights[i, t] · values[rows[i, t]]`` over t to ``out[i]``."""
    channels = values.shape[1]
    for i in range(len(weights)):
        total = out[i]
        total[:] = 0
        for t in range(weights.shape[1]):
            weight = weights[i, t]
            line = values[rows[i, t]]
            for c in range(channels):
                total[c] += weight * line[c]


@jit_sums
def sums_backward(gradients, weights, rows, values, weight_gradients, value_gradients):
    """Add the gradients of ``sums`` to those of weights and values."""
    channels = values.shape[1]
    for i in range(len(weights)):
        gradient = gradients[i]
        for t in range(weights.shape[1]):
            weight = weights[i, t]
            line, line_gradient = values[rows[i, t]], value_gradients[rows[i, t]]
            product = weights.dtype.type(0)
            for c in range(channels):
                product += gradient[c] * line[c]
                line_gradient[c] += weight * gradient[c]
            weight_gradients[i, t] += product
