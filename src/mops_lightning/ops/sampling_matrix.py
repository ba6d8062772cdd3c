"""The sampling matrix S of MOPS-Net, which need not exist.

The last layer of ρ is linear and its bias is constant down a column, so the column softmax (paper
section "Learning Differentiable Sampling Matrix") cancels it. Column j of S is therefore the
softmax over points of ⟨w_j, h_i⟩/τ, and Q = SᵀP is one scaled dot-product attention with queries
W ``(M, C)``, keys H ``(B, N, C)`` and values P ``(B, N, 3)``. A softmax over points can be reduced
block by block (running maximum, sum, weighted sum), so Q never needs N·M numbers at once.
"""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

LOG2_E = 1 / math.log(2)
"""Logits are taken to the base 2 in blocks, since powers of 2 are quicker than those of e."""

PROBES = 64
"""About so many points of a cloud show how large a column's logits are."""

GRAM_ROWS = 256
"""Rows of SᵀS that are computed together."""


class Blocks(NamedTuple):
    """How S is cut into pieces on a device.

    Attributes:
        dense: up to this many entries of S per batch the plain dense product is as good as any.
        queries: columns of S in a block.
        points: rows of S in a block.
    """

    dense: int
    queries: int
    points: int


BLOCKS = {"cpu": Blocks(2**22, 2048, 512), "cuda": Blocks(2**26, 4096, 2**14)}
"""On a CPU a block's logits, 4 MiB in float32, stay in the last-level cache, and its keys in the
second; on a GPU a block should keep all of it busy."""


def _blocks_on(device: torch.device) -> Blocks:
    return BLOCKS.get(device.type, BLOCKS["cuda"])


class SamplingMatrix(NamedTuple):
    """S by its parts.

    Attributes:
        queries: ``(M, C)``, the last layer of ρ without its bias.
        keys: ``(B, N, C)``, what that layer is applied to.
        tau: temperature of the softmax.
    """

    queries: Tensor
    keys: Tensor
    tau: float

    def dense(self) -> Tensor:
        """Return S itself, ``(B, N, M)``: every column is non-negative and sums to 1."""
        return self._columns().mT

    def sample(self, points: Tensor) -> Tensor:
        """Return Q = SᵀP (paper section "Efficient Regression of the Sampled Set").

        Args:
            points: ``(B, N, 3)``, or any other values per point.

        Returns:
            ``(B, M, 3)``; differentiable in queries, keys and points. Above ``Blocks.dense``
            entries S is recomputed block by block in the backward pass too.
        """
        entries = self.keys.shape[0] * self.keys.shape[1] * self.queries.shape[0]
        if entries <= _blocks_on(self.keys.device).dense:
            # Values whose columns lie together in memory halve the time of the product.
            return self._columns() @ points.mT.contiguous().mT
        return _StreamedAttention.apply(self.queries / self.tau, self.keys, points)

    def sparse(self, threshold: float = 0.01) -> Tensor:
        """Return S in coordinate (COO) form, as the paper stores it for inference.

        Entries below ``threshold`` are dropped and the columns renormalised to sum 1; a column in
        which nothing reaches the threshold keeps its largest entry.

        Returns:
            Sparse ``(B, N, M)``, coalesced; not differentiable.
        """
        batch, number, m = self.keys.shape[0], self.keys.shape[1], len(self.queries)
        coordinates, values = [], []
        with torch.no_grad():
            peak = torch.full((batch, m), -1.0, dtype=self.keys.dtype, device=self.keys.device)
            place = torch.zeros((batch, m), dtype=torch.int64, device=self.keys.device)
            for cloud, rows, columns, block in self._blocks():
                high, at = block.max(1)
                better = high > peak[cloud, columns]
                peak[cloud, columns] = torch.where(better, high, peak[cloud, columns])
                place[cloud, columns] = torch.where(better, at + rows.start, place[cloud, columns])
                column, row = (block >= threshold).nonzero(as_tuple=True)
                values.append(block[column, row])
                batch_index = torch.full_like(row, cloud)
                coordinates.append(
                    torch.stack([batch_index, row + rows.start, column + columns.start])
                )
            cloud_index, column_index = (peak < threshold).nonzero(as_tuple=True)
            values.append(peak[cloud_index, column_index])
            coordinates.append(
                torch.stack([cloud_index, place[cloud_index, column_index], column_index])
            )
            index, value = torch.cat(coordinates, 1), torch.cat(values)
            column = index[0] * m + index[2]
            total = value.new_zeros(batch * m).index_add_(0, column, value)
            return torch.sparse_coo_tensor(
                index, value / total[column], (batch, number, m), check_invariants=True
            ).coalesce()

    def leftmost(self, m: int) -> "SamplingMatrix":
        """Return the matrix of the first ``m`` columns (paper section "Flexible MOPS-Net")."""
        return self._replace(queries=self.queries[:m])

    def nonzero_counts(self, threshold: float = 0.01) -> Tensor:
        """Return how many entries of every column reach ``threshold``: ``(B, M)``, no gradients."""
        with torch.no_grad():
            counts = self.keys.new_zeros(self.keys.shape[0], len(self.queries))
            for cloud, _, columns, block in self._blocks():
                counts[cloud, columns] += (block >= threshold).sum(1)
            return counts

    def gram(self) -> Tensor:
        """Return SᵀS, ``(B, M, M)``, the identity for an ideal sampling matrix; no gradients."""
        m = len(self.queries)
        with torch.no_grad():
            result = self.keys.new_zeros(self.keys.shape[0], m, m)
            for cloud, _, _, block in self._blocks(block_queries=m):
                # Only what lies right of the diagonal, which saves nearly half.
                for part in _slices(m, GRAM_ROWS):
                    result[cloud, part, part.start :] += block[part] @ block[part.start :].mT
            return result.triu() + result.triu(1).mT

    def _columns(self) -> Tensor:
        """Return Sᵀ, ``(B, M, N)``: points last, so that the softmax runs along memory."""
        return ((self.queries / self.tau) @ self.keys.mT).softmax(-1)

    def _blocks(
        self, block_queries: int | None = None
    ) -> Iterator[tuple[int, slice, slice, Tensor]]:
        """Yield (cloud, rows, columns, block of Sᵀ) over all of S."""
        queries = self.queries / self.tau
        no_values = self.keys.new_zeros(*self.keys.shape[:2], 0)
        _, log_sum = _attend(queries, self.keys, no_values)
        powers, size = queries * LOG2_E, _blocks_on(queries.device)
        for cloud, keys in enumerate(self.keys):
            for columns in _slices(len(queries), block_queries or size.queries):
                for rows in _slices(len(keys), size.points):
                    share = _shares(powers[columns], keys[rows], log_sum[cloud, columns])
                    yield cloud, rows, columns, share


def _slices(total: int, size: int) -> list[slice]:
    return [slice(start, min(start + size, total)) for start in range(0, total, size)]


def _shares(powers: Tensor, keys: Tensor, level: Tensor) -> Tensor:
    """Return 2^(⟨power, key⟩ - level), ``(columns, rows)``; powers are queries to the base 2."""
    return (powers @ keys.mT).sub_(level[:, None]).exp2_()


class Partial(NamedTuple):
    """The softmax-weighted sum over some of a cloud's points; such sums merge to that over all.

    Logits and their level are to the base 2.

    Attributes:
        level: ``(M,)``, what every column's logits are measured from, so that no power of 2 is
            too large for its type and not all are too small.
        total: ``(M,)``, the sum of 2^(logit - level).
        weighted: ``(M, V)``, the sum of 2^(logit - level) times the point's values.
    """

    level: Tensor
    total: Tensor
    weighted: Tensor

    def merge(self, other: "Partial") -> "Partial":
        """Return the sum over the points of both, in whatever order they are merged."""
        level = torch.maximum(self.level, other.level)
        mine, theirs = (self.level - level).exp2(), (other.level - level).exp2()
        return Partial(
            level,
            self.total * mine + other.total * theirs,
            self.weighted * mine[:, None] + other.weighted * theirs[:, None],
        )

    def result(self) -> Tensor:
        """Return the weighted mean ``(M, V)``."""
        return self.weighted / self.total[:, None]


@torch.no_grad()
def attend(queries: Tensor, keys: Tensor, values: Tensor) -> Partial:
    """Sum values over points with the weights exp⟨query, key⟩, without the M·N logits at once.

    What a column's logits are measured from cancels, so it need not be their maximum, which would
    take a pass over all of them: the maximum over a few points nearly always serves. Columns where
    it does not are taken again from their true maximum, at worst at three times the cost.

    Args:
        queries: ``(M, C)``, already divided by the temperature.
        keys: ``(N, C)``, N at least 1.
        values: ``(N, V)``.
    """
    powers = queries * LOG2_E
    # Ones give the sum of the weights as well. Columns together in memory halve the product's time.
    held = torch.cat([values.mT, values.new_ones(1, len(values))]).mT
    probes = keys[:: max(len(keys) // PROBES, 1)]
    # Sums up to here can be merged, and multiplied by any value of their own size.
    high = math.sqrt(torch.finfo(held.dtype).max)
    level = powers.new_empty(len(powers))
    sums = held.new_empty(len(powers), held.shape[1])
    for columns in _slices(len(powers), _blocks_on(keys.device).queries):
        here = powers[columns]
        near = (here @ probes.mT).amax(1)
        found = _sums(here, keys, held, near)
        unsure = ~((found[:, -1] > 0.5) & (found[:, -1] < high))
        if unsure.any():
            near[unsure], found[unsure] = _sums_from_peaks(here[unsure], keys, held)
        level[columns], sums[columns] = near, found
    return Partial(level, sums[:, -1], sums[:, :-1])


def _sums(powers: Tensor, keys: Tensor, held: Tensor, level: Tensor) -> Tensor:
    """Return the sums of ``held`` with the weights 2^(⟨power, key⟩ - level)."""
    blocks = _slices(len(keys), _blocks_on(keys.device).points)
    result = held.new_zeros(len(powers), held.shape[1])
    room = keys.new_empty(len(powers) * (blocks[0].stop - blocks[0].start))
    for rows in blocks:
        shape = (len(powers), rows.stop - rows.start)
        out = room[: math.prod(shape)].view(shape)
        shares = torch.addmm(-level[:, None], powers, keys[rows].mT, out=out).exp2_()
        # Not addmm_: its sums would run over all points one by one, and lose digits.
        result += shares @ held[rows]
    return result


def _sums_from_peaks(powers: Tensor, keys: Tensor, held: Tensor) -> tuple[Tensor, Tensor]:
    """Return the largest logits, and the same sums measured from them."""
    whole: Partial | None = None
    for rows in _slices(len(keys), _blocks_on(keys.device).points):
        logits = powers @ keys[rows].mT
        peak = logits.amax(1)
        sums = logits.sub_(peak[:, None]).exp2_() @ held[rows]
        part = Partial(peak, sums[:, -1], sums)
        whole = part if whole is None else whole.merge(part)
    assert whole is not None
    return whole.level, whole.weighted


def _attend(queries: Tensor, keys: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """Return softmax-weighted values ``(B, M, V)`` and the sums' logarithms to the base 2."""
    wholes = [attend(queries, *cloud) for cloud in zip(keys, values, strict=True)]
    results = torch.stack([whole.result() for whole in wholes])
    return results, torch.stack([whole.level + whole.total.log2() for whole in wholes])


class _StreamedAttention(torch.autograd.Function):
    """Q = SᵀP in blocks, forwards and backwards; S is never held."""

    @staticmethod
    def forward(ctx: Any, queries: Tensor, keys: Tensor, values: Tensor) -> Tensor:
        result, log_sum = _attend(queries, keys, values)
        ctx.save_for_backward(queries, keys, values, result, log_sum)
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        queries, keys, values, result, log_sum = ctx.saved_tensors
        (grad,) = grads
        grad_queries, grad_keys = torch.zeros_like(queries), torch.zeros_like(keys)
        grad_values = torch.zeros_like(values)
        # The softmax's backward: dS = S ∘ (dA − ⟨dQ, Q⟩), with dA = dQ·Pᵀ.
        inner = (grad * result).sum(-1)
        powers, size = queries * LOG2_E, _blocks_on(keys.device)
        for cloud in range(len(keys)):
            for columns in _slices(len(queries), size.queries):
                for rows in _slices(keys.shape[1], size.points):
                    key = keys[cloud, rows]
                    share = _shares(powers[columns], key, log_sum[cloud, columns])
                    if ctx.needs_input_grad[2]:
                        # A few rows on the left are quicker than a few columns on the right.
                        grad_values[cloud, rows] += (grad[cloud, columns].mT @ share).mT
                    change = grad[cloud, columns] @ values[cloud, rows].mT
                    change.sub_(inner[cloud, columns, None]).mul_(share)
                    grad_queries[columns] += change @ key
                    grad_keys[cloud, rows] += change.mT @ queries[columns]
        return grad_queries, grad_keys, grad_values
