"""The sampling matrix S of MOPS-Net, which need not exist.

The last layer of ρ is linear and its bias is constant down a column, so the column softmax (paper
section "Learning Differentiable Sampling Matrix") cancels it. Column j of S is therefore the
softmax over points of ⟨w_j, h_i⟩/τ, and Q = SᵀP is one scaled dot-product attention with queries
W ``(M, C)``, keys H ``(B, N, C)`` and values P ``(B, N, 3)``. A softmax over points can be reduced
block by block (running maximum, sum, weighted sum), so Q never needs N·M numbers at once.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

DENSE_LIMIT = 2**22
"""Up to this many entries of S per batch the plain dense product is as good as any."""
BLOCK_QUERIES = 512
BLOCK_POINTS = 2048
"""Blocks of 2^20 logits, 4 MiB in float32: they stay in the last-level cache."""


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
            ``(B, M, 3)``; differentiable in queries, keys and points. Above ``DENSE_LIMIT`` entries
            S is recomputed block by block in the backward pass too.
        """
        entries = self.keys.shape[0] * self.keys.shape[1] * self.queries.shape[0]
        if entries <= DENSE_LIMIT:
            return self._columns() @ points
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
                result[cloud] += block @ block.mT
            return result

    def _columns(self) -> Tensor:
        """Return Sᵀ, ``(B, M, N)``: points last, so that the softmax runs along memory."""
        return ((self.queries / self.tau) @ self.keys.mT).softmax(-1)

    def _blocks(
        self, block_queries: int = BLOCK_QUERIES
    ) -> Iterator[tuple[int, slice, slice, Tensor]]:
        """Yield (cloud, rows, columns, block of Sᵀ) over all of S."""
        queries = self.queries / self.tau
        no_values = self.keys.new_zeros(*self.keys.shape[:2], 0)
        _, log_sum = _attend(queries, self.keys, no_values)
        for cloud, keys in enumerate(self.keys):
            for columns in _slices(len(queries), block_queries):
                for rows in _slices(len(keys), BLOCK_POINTS):
                    logits = queries[columns] @ keys[rows].mT
                    yield cloud, rows, columns, _shares(logits, log_sum[cloud, columns])


def _slices(total: int, size: int) -> list[slice]:
    return [slice(start, min(start + size, total)) for start in range(0, total, size)]


def _shares(logits: Tensor, log_sum: Tensor) -> Tensor:
    """Turn logits ``(columns, rows)`` into entries of Sᵀ, in place."""
    return logits.sub_(log_sum[:, None]).exp_()


class Partial(NamedTuple):
    """The softmax-weighted sum over some of a cloud's points; such sums merge to that over all.

    Attributes:
        peak: ``(M,)``, the largest logit of every column.
        total: ``(M,)``, the sum of exp(logit - peak).
        weighted: ``(M, V)``, the sum of exp(logit - peak) times the point's values.
    """

    peak: Tensor
    total: Tensor
    weighted: Tensor

    def merge(self, other: "Partial") -> "Partial":
        """Return the sum over the points of both, in whatever order they are merged."""
        peak = torch.maximum(self.peak, other.peak)
        mine, theirs = (self.peak - peak).exp(), (other.peak - peak).exp()
        return Partial(
            peak,
            self.total * mine + other.total * theirs,
            self.weighted * mine[:, None] + other.weighted * theirs[:, None],
        )

    def result(self) -> Tensor:
        """Return the weighted mean ``(M, V)``."""
        return self.weighted / self.total[:, None]


def attend(queries: Tensor, keys: Tensor, values: Tensor) -> Partial:
    """Sum values over points with the weights exp⟨query, key⟩, without the M·N logits at once.

    Args:
        queries: ``(M, C)``, already divided by the temperature.
        keys: ``(N, C)``.
        values: ``(N, V)``.
    """
    m = len(queries)
    whole = Partial(keys.new_empty(m), keys.new_empty(m), values.new_empty(m, values.shape[1]))
    # A product with a few rows on the left takes a third of that with a few columns on the right;
    # a row of ones gives the sum as well.
    held = torch.cat([values, values.new_ones(len(values), 1)], 1).mT.contiguous()
    for columns in _slices(m, BLOCK_QUERIES):
        parts: Partial | None = None
        for rows in _slices(len(keys), BLOCK_POINTS):
            logits = queries[columns] @ keys[rows].mT
            peak = logits.amax(1)
            sums = held[:, rows] @ _shares(logits, peak).mT
            part = Partial(peak, sums[-1], sums[:-1].mT)
            parts = part if parts is None else parts.merge(part)
        assert parts is not None
        for kept, found in zip(whole, parts, strict=True):
            kept[columns] = found
    return whole


def _attend(queries: Tensor, keys: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """Return softmax-weighted values ``(B, M, V)`` and the log of the softmax sums ``(B, M)``."""
    wholes = [attend(queries, *cloud) for cloud in zip(keys, values, strict=True)]
    results = torch.stack([whole.result() for whole in wholes])
    return results, torch.stack([whole.peak + whole.total.log() for whole in wholes])


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
        for cloud in range(len(keys)):
            for columns in _slices(len(queries), BLOCK_QUERIES):
                for rows in _slices(keys.shape[1], BLOCK_POINTS):
                    share = _shares(
                        queries[columns] @ keys[cloud, rows].mT, log_sum[cloud, columns]
                    )
                    change = grad[cloud, columns] @ values[cloud, rows].mT
                    change.sub_(inner[cloud, columns, None]).mul_(share)
                    grad_queries[columns] += change @ keys[cloud, rows]
                    grad_keys[cloud, rows] += change.mT @ queries[columns]
                    grad_values[cloud, rows] += (grad[cloud, columns].mT @ share).mT
        return grad_queries, grad_keys, grad_values
