"""Maxima over neighbourhoods, without a tensor of all neighbours' features."""

# mypy: disable-error-code="no-untyped-def"

from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from mops_lightning.ops.jit import jit_cached

THREADS_MIN_RESULTS = 2**18
"""Minimum number of maxima for using several threads."""


def max_of_rows(features: Tensor, rows: Tensor) -> Tensor:
    """Return the maximum of every channel over selected rows.

    On a CPU, a compiled loop finds the winning rows; the first call compiles for 1 s.

    Args:
        features: ``(B, N, C)``.
        rows: ``(B, M, k)`` int64.

    Returns:
        ``(B, M, C)``; gradients flow to the winning rows.
    """
    clouds, n, channels = features.shape
    places = (rows + torch.arange(clouds, device=rows.device)[:, None, None] * n).flatten(0, 1)
    flat = features.flatten(0, 1)
    if flat.device.type != "cpu" or flat.dtype.itemsize < 4 or torch.compiler.is_compiling():
        best = F.embedding_bag(places, flat, mode="max")
    else:
        best = flat.gather(0, _winners(flat.detach().contiguous(), places))
    return best.view(clouds, -1, channels)


def _winners(features: Tensor, places: Tensor) -> Tensor:
    """Return, for lines of rows, the one with the largest feature in every channel."""
    out = torch.empty(len(places), features.shape[1], dtype=torch.int64)
    workers = torch.get_num_threads() if out.numel() >= THREADS_MIN_RESULTS else 1
    lines, results = (np.array_split(part.numpy(), workers) for part in (places, out))
    find = partial(_write_winners, features.numpy())
    if workers == 1:
        find(lines[0], results[0])
    else:
        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(find, lines, results))
    return out


@jit_cached
def _write_winners(features, places, out):
    """Write the winners of all lines of places."""
    best = np.empty(features.shape[1], features.dtype)
    winner = np.empty(features.shape[1], np.int32)  # narrow, which is faster
    for i in range(len(places)):
        best[:] = features[places[i, 0]]
        winner[:] = 0
        for j in range(1, places.shape[1]):
            line = features[places[i, j]]
            for c in range(len(best)):
                larger = line[c] > best[c] or line[c] != line[c]  # NaN is passed on
                best[c] = line[c] if larger else best[c]
                winner[c] = j if larger else winner[c]
        for c in range(len(best)):
            out[i, c] = places[i, winner[c]]
