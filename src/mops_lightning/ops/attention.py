"""Softmax attention over the points of a cloud without the full matrix of logits.

A softmax over points can be reduced block by block (maximum, sum, weighted sum). Sums over parts of
a cloud can be merged, so that clouds may be read in chunks, from disk or by several machines.
"""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from mops_lightning.ops.precision import full_precision

LOG2_E = 1 / math.log(2)
"""Logits in blocks are to the base 2, because exp2 is faster than exp."""

PROBES = 64
"""Approximate number of points from which the size of a column's logits is estimated."""


class Blocks(NamedTuple):
    """Block sizes of the sampling matrix S on a device.

    Attributes:
        dense: up to this number of entries of S per batch, a dense product is as fast as blocks.
        queries: columns of S per block.
        points: rows of S per block.
    """

    dense: int
    queries: int
    points: int


BLOCKS = {
    "cpu": Blocks(dense=2**22, queries=2048, points=512),
    "cuda": Blocks(dense=2**26, queries=4096, points=2**14),
}
"""On a CPU, the logits of a block (4 MiB in float32) fit into the last-level cache, and its keys
into the second-level cache. On a GPU, a block keeps the whole device busy."""


def blocks_on(device: torch.device) -> Blocks:
    """Return the block sizes for a device."""
    return BLOCKS.get(device.type, BLOCKS["cuda"])


def slices(total: int, size: int) -> list[slice]:
    """Split ``range(total)`` into slices of at most ``size``."""
    starts = range(0, total, size)
    return [slice(start, min(start + size, total)) for start in starts]


def softmax_weights(powers: Tensor, keys: Tensor, level: Tensor) -> Tensor:
    """Return 2^(⟨power, key⟩ − level) for a block of columns and points.

    Args:
        powers: ``(M, C)``, queries times ``LOG2_E``.
        keys: ``(N, C)``.
        level: ``(M,)``, base-2 logarithms of the softmax denominators.

    Returns:
        ``(M, N)``.
    """
    with full_precision(keys.device.type):
        logits = powers @ keys.mT
        return logits.sub_(level[:, None]).exp2_()


class Partial(NamedTuple):
    """Softmax-weighted sum over some points of a cloud; two such sums can be merged.

    Logits and levels are to the base 2.

    Attributes:
        level: ``(M,)``, subtracted from a column's logits, so that their powers of 2 neither
            overflow nor all underflow.
        total: ``(M,)``, the sum of 2^(logit − level).
        weighted: ``(M, V)``, the sum of 2^(logit − level) times the values of the points.
    """

    level: Tensor
    total: Tensor
    weighted: Tensor

    def merge(self, other: "Partial") -> "Partial":
        """Return the sum over the points of both; the order of merging affects rounding only."""
        level = torch.maximum(self.level, other.level)
        mine = (self.level - level).exp2()
        theirs = (other.level - level).exp2()
        total = self.total * mine + other.total * theirs
        weighted = self.weighted * mine[:, None] + other.weighted * theirs[:, None]
        return Partial(level, total, weighted)

    def result(self) -> Tensor:
        """Return the weighted mean ``(M, V)``."""
        return self.weighted / self.total[:, None]


@torch.no_grad()
def attend(queries: Tensor, keys: Tensor, values: Tensor) -> Partial:
    """Sum values over points with the weights exp⟨query, key⟩, with bounded memory.

    The level of a column cancels in the result, so it need not be the maximum logit, which would
    take a pass over all points: the maximum over a few points is almost always sufficient. Columns
    for which it is not are computed again from their maximum, at up to three times the cost.

    Args:
        queries: ``(M, C)``, already divided by the temperature.
        keys: ``(N, C)``, N ≥ 1.
        values: ``(N, V)``.

    Returns:
        The sum over all N points; its ``result()`` is the softmax attention ``(M, V)``.
    """
    powers = queries * LOG2_E
    # The column of ones gives the sum of the weights. Contiguous columns halve the product's time.
    ones = values.new_ones(1, len(values))
    extended = torch.cat([values.mT, ones]).mT
    stride = max(len(keys) // PROBES, 1)
    probes = keys[::stride]
    # Sums up to this limit can be merged, and multiplied by a value of the same size.
    limit = math.sqrt(torch.finfo(extended.dtype).max)
    level = powers.new_empty(len(powers))
    sums = extended.new_empty(len(powers), extended.shape[1])
    with full_precision(keys.device.type):
        for columns in slices(len(powers), blocks_on(keys.device).queries):
            block = powers[columns]
            estimate = (block @ probes.mT).amax(1)
            total = _sums(block, keys, extended, estimate)
            weight_sums = total[:, -1]
            is_safe = (weight_sums > 0.5) & (weight_sums < limit)
            unsure = ~is_safe
            if unsure.any():
                exact_level, exact_total = _sums_from_maxima(block[unsure], keys, extended)
                estimate[unsure] = exact_level
                total[unsure] = exact_total
            level[columns] = estimate
            sums[columns] = total
    return Partial(level, total=sums[:, -1], weighted=sums[:, :-1])


def _sums(powers: Tensor, keys: Tensor, extended: Tensor, level: Tensor) -> Tensor:
    """Return the sums of ``extended`` with the weights 2^(⟨power, key⟩ − level)."""
    blocks = slices(len(keys), blocks_on(keys.device).points)
    result = extended.new_zeros(len(powers), extended.shape[1])
    largest = blocks[0].stop - blocks[0].start
    buffer = keys.new_empty(len(powers) * largest)
    offset = -level[:, None]
    for rows in blocks:
        shape = (len(powers), rows.stop - rows.start)
        out = buffer[: math.prod(shape)].view(shape)
        logits = torch.addmm(offset, powers, keys[rows].mT, out=out)
        weights = logits.exp2_()
        # addmm_ would accumulate over all points one by one, which loses precision.
        result += weights @ extended[rows]
    return result


def _sums_from_maxima(powers: Tensor, keys: Tensor, extended: Tensor) -> tuple[Tensor, Tensor]:
    """Return the maximum logits, and the sums with these as levels."""
    merged: Partial | None = None
    for rows in slices(len(keys), blocks_on(keys.device).points):
        logits = powers @ keys[rows].mT
        peak = logits.amax(1)
        weights = logits.sub_(peak[:, None]).exp2_()
        sums = weights @ extended[rows]
        part = Partial(peak, sums[:, -1], sums)
        if merged is None:
            merged = part
        else:
            merged = merged.merge(part)
    assert merged is not None
    return merged.level, merged.weighted


def per_cloud(queries: Tensor, clouds: int) -> list[Tensor]:
    """Return the queries ``(M, C)`` of every cloud: views of ``(M, C)`` or ``(B, M, C)``."""
    if queries.ndim == 2:
        return [queries] * clouds
    return list(queries)


def attend_batch(queries: Tensor, keys: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """Return the softmax attention of every cloud and the logarithms of its denominators.

    Args:
        queries: ``(M, C)`` or ``(B, M, C)``, already divided by the temperature.
        keys: ``(B, N, C)``.
        values: ``(B, N, V)``.

    Returns:
        ``(B, M, V)``, and ``(B, M)`` to the base 2; without gradients.
    """
    queries_of_each = per_cloud(queries, len(keys))
    clouds = zip(queries_of_each, keys, values, strict=True)
    sums = [attend(*cloud) for cloud in clouds]
    results = torch.stack([cloud.result() for cloud in sums])
    log_sums = torch.stack([cloud.level + cloud.total.log2() for cloud in sums])
    return results, log_sums


def streamed_attention(queries: Tensor, keys: Tensor, values: Tensor) -> Tensor:
    """Return the softmax attention of every cloud, computed in blocks in both passes.

    Args:
        queries: ``(M, C)`` or ``(B, M, C)``, already divided by the temperature.
        keys: ``(B, N, C)``.
        values: ``(B, N, V)``.

    Returns:
        ``(B, M, V)``; gradients flow to all arguments.
    """
    return _StreamedAttention.apply(queries, keys, values)


class _StreamedAttention(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, queries: Tensor, keys: Tensor, values: Tensor) -> Tensor:
        result, log_sum = attend_batch(queries, keys, values)
        ctx.save_for_backward(queries, keys, values, result, log_sum)
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        queries, keys, values, result, log_sum = ctx.saved_tensors
        (grad,) = grads
        grad_queries = torch.zeros_like(queries)
        grad_keys = torch.zeros_like(keys)
        grad_values = torch.zeros_like(values)
        # Backward pass of the softmax: dS = S ∘ (dA − ⟨dQ, Q⟩), with dA = dQ·Pᵀ.
        inner = (grad * result).sum(-1)
        clouds = len(keys)
        size = blocks_on(keys.device)
        each = per_cloud(queries, clouds)
        powers = per_cloud(queries * LOG2_E, clouds)
        grad_each = per_cloud(grad_queries, clouds)
        for cloud in range(clouds):
            for columns in slices(queries.shape[-2], size.queries):
                given = grad[cloud, columns]
                level = log_sum[cloud, columns]
                inner_columns = inner[cloud, columns, None]
                for rows in slices(keys.shape[1], size.points):
                    key = keys[cloud, rows]
                    weights = softmax_weights(powers[cloud][columns], key, level)
                    if ctx.needs_input_grad[2]:
                        # A few rows on the left are faster than a few columns on the right.
                        grad_of_values = given.mT @ weights
                        grad_values[cloud, rows] += grad_of_values.mT
                    change = given @ values[cloud, rows].mT
                    change.sub_(inner_columns).mul_(weights)
                    grad_each[cloud][columns] += change @ key
                    grad_keys[cloud, rows] += change.mT @ each[cloud][columns]
        return grad_queries, grad_keys, grad_values
