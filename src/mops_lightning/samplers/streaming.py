"""Sampling clouds that do not fit in memory, in chunks and on several machines.

MOPS-Net sees a cloud in two reductions over its points, a maximum (the global feature) and a
softmax-weighted sum (paper section "Efficient Regression of the Sampled Set"). Both can be taken
chunk by chunk, and parts of them merged in any order, so memory does not grow with N, and workers
may share a cloud.
"""

from collections.abc import Callable, Iterable
from functools import reduce

import torch
from torch import Tensor

from mops_lightning.errors import UserError
from mops_lightning.ops.attention import Partial, attend
from mops_lightning.ops.nearest import nearest
from mops_lightning.samplers.base import check_points
from mops_lightning.samplers.fused import FusedMOPSNet
from mops_lightning.samplers.mops import MOPSNet

Chunks = Callable[[], Iterable[Tensor]]
"""Gives a cloud's points anew at each call, as tensors ``(n, 3)`` in the same order."""


def stream_sample(sampler: MOPSNet, chunks: Chunks, m: int | None = None) -> Tensor:
    """Generate the points that ``sampler`` gives for the whole cloud, from chunks of it.

    Args:
        sampler: trained; it is used as in evaluation.
        chunks: the cloud, gone through twice; memory is bounded by the largest chunk.
        m: how many points; None: ``sampler.m``.

    Returns:
        ``(m, 3)``, equal to ``sampler(points, m).points`` up to the rounding of sums.

    Raises:
        UserError: the sampler is of another kind, or a chunk is not a cloud of points.
    """
    if not isinstance(sampler, MOPSNet):
        raise UserError(
            f"sampler: chunks can be sampled by MOPSNet and FMOPSNet, got {type(sampler).__name__}."
        )
    m = sampler.m if m is None else m
    sampler._check_m(m)
    net = sampler.fused()
    peaks = (global_part(net, chunk) for chunk in _checked(chunks, m))
    global_ = reduce(torch.maximum, peaks)
    return reduce(Partial.merge, (sum_part(net, chunk, global_, m) for chunk in chunks())).result()


def global_part(net: FusedMOPSNet, points: Tensor) -> Tensor:
    """Return what some points ``(n, 3)`` contribute to the global feature; the maximum merges."""
    return net.local_features(points).amax(0)


def sum_part(net: FusedMOPSNet, points: Tensor, global_: Tensor, m: int) -> Partial:
    """Return what some points ``(n, 3)`` contribute to the m generated ones; ``Partial.merge``."""
    with torch.no_grad():
        keys = net.keys(net.local_features(points), global_)
        return attend(net.queries[:m], keys, points)


def stream_match(generated: Tensor, chunks: Chunks) -> Tensor:
    """Return, for every generated point ``(m, 3)``, the row of its nearest point of the cloud.

    The same as ``readout.match``, the lowest row where several are equally near.
    """
    best = torch.full((len(generated),), torch.inf)
    rows = torch.zeros(len(generated), dtype=torch.int64)
    start = 0
    for chunk in chunks():
        distance, row = (found[0].cpu() for found in nearest(generated[None], chunk[None]))
        nearer = distance < best
        rows[nearer] = row[nearer] + start
        best = torch.minimum(best, distance)
        start += len(chunk)
    return rows


def _checked(chunks: Chunks, m: int) -> Iterable[Tensor]:
    number = 0
    for chunk in chunks():
        check_points(chunk[None])
        number += len(chunk)
        yield chunk
    if number < m:
        raise UserError(f"m must be at most the number of points N={number}, got m={m}.")
