"""Sampling clouds that do not fit in memory, in chunks and on several machines.

MOPS-Net reduces the points of a cloud twice: to a maximum (the global feature) and to a
softmax-weighted sum (paper section "Efficient Regression of the Sampled Set"). Both reductions are
associative. They can be computed chunk by chunk and merged in any order, so that memory does not
grow with N, and several workers can share a cloud.
"""

from collections.abc import Callable, Iterable
from functools import reduce

import torch
from torch import Tensor

from mops_lightning.errors import UserError
from mops_lightning.ops.attention import Partial
from mops_lightning.samplers.base import Sampler, check_dtype, check_points

Chunks = Callable[[], Iterable[Tensor]]
"""Function that iterates over the chunks ``(n, 3)`` of a cloud, in the same order at every call."""


def stream_sample(sampler: Sampler, chunks: Chunks, m: int | None = None) -> Tensor:
    """Sample a cloud that is read in chunks.

    Args:
        sampler: a trained sampler; it is used in evaluation mode.
        chunks: the cloud, which is read twice; the largest chunk bounds the memory.
        m: number of points; None means ``sampler.m``.

    Returns:
        ``(m, 3)``, equal to ``sampler(points, m).points`` up to the rounding of sums.

    Raises:
        UserError: the sampler needs whole clouds, ``m`` is out of range, or a chunk is invalid.
    """
    m = sampler.m if m is None else m
    net = sampler.fused()
    sampler.check_m(m)
    peaks = (net.global_part(chunk) for chunk in _checked(chunks, m, sampler))
    global_ = reduce(torch.maximum, peaks)
    return reduce(Partial.merge, (net.sum_part(chunk, global_, m) for chunk in chunks())).result()


def _checked(chunks: Chunks, m: int, sampler: Sampler) -> Iterable[Tensor]:
    number = 0
    for chunk in chunks():
        check_points(chunk[None])
        check_dtype(chunk, next(sampler.parameters()).dtype)
        number += len(chunk)
        yield chunk
    if number < m:
        raise UserError(f"m must be at most the number of points N={number}, got m={m}.")
