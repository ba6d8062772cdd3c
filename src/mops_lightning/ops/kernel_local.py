"""Products of queries with chosen keys, compiled by numba for ``ops.local_attention``."""

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
