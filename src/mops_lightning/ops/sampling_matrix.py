"""The sampling matrix S of MOPS-Net, represented by queries, keys and a temperature.

The last layer of ρ is linear, and its bias is constant within a column of S, so that the column
softmax (paper section "Learning Differentiable Sampling Matrix", Eq. 5) cancels it. Column j of S
is therefore the softmax over points of ⟨w_j, h_i⟩/τ, and Q = SᵀP is scaled dot-product attention
with queries W ``(M, C)``, keys H ``(B, N, C)`` and values P ``(B, N, 3)``. S itself, with N·M
entries, is never needed to compute Q.
"""

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from mops_lightning.ops.attention import (
    LOG2_E,
    attend_batch,
    blocks_on,
    per_cloud,
    slices,
    softmax_weights,
    streamed_attention,
)
from mops_lightning.ops.precision import full_precision

GRAM_ROWS = 256
"""Rows of SᵀS that are computed together."""


class SamplingMatrix(NamedTuple):
    """Sampling matrices S of a batch of clouds (paper Eq. 5), as scaled dot-product attention.

    Attributes:
        queries: ``(M, C)``, the weights of the last layer of ρ; or ``(B, M, C)``, queries of every
            cloud.
        keys: ``(B, N, C)``, the input of that layer.
        tau: temperature τ of the softmax.

    Examples:
        >>> import torch
        >>> from mops_lightning import SamplingMatrix
        >>> queries, keys = torch.rand(8, 16), torch.rand(2, 64, 16)
        >>> matrix = SamplingMatrix(queries, keys, tau=0.1)
        >>> matrix.sample(torch.rand(2, 64, 3)).shape, matrix.dense().shape
        (torch.Size([2, 8, 3]), torch.Size([2, 64, 8]))
    """

    queries: Tensor
    keys: Tensor
    tau: float

    @property
    def m(self) -> int:
        """Number of columns of S."""
        return self.queries.shape[-2]

    @property
    def dtype(self) -> torch.dtype:
        """The type of the entries."""
        return self.keys.dtype

    def dense(self) -> Tensor:
        """Return S as ``(B, N, M)``: every column is non-negative and sums to 1."""
        return self._columns().mT

    def sample(self, points: Tensor) -> Tensor:
        """Return Q = SᵀP (paper section "Efficient Regression of the Sampled Set", Eq. 6).

        Args:
            points: ``(B, N, 3)``, or any other values per point.

        Returns:
            ``(B, M, 3)``; differentiable in queries, keys and points. Above ``Blocks.dense``
            entries, S is computed block by block, and again in the backward pass.
        """
        clouds, points_in_cloud, _ = self.keys.shape
        entries = clouds * points_in_cloud * self.m
        if entries <= blocks_on(self.keys.device).dense:
            return self.sample_dense(points)
        return streamed_attention(self.queries / self.tau, self.keys, points)

    def sample_dense(self, points: Tensor) -> Tensor:
        """Return the same as ``sample``, with all of S in memory at any size."""
        # Values with contiguous columns halve the time of the product.
        return self._columns() @ points.mT.contiguous().mT

    def sparse(self, threshold: float = 0.01) -> Tensor:
        """Return S in coordinate (COO) format, as the paper stores it for inference.

        Paper section "Efficient Regression of the Sampled Set". Entries below ``threshold`` are
        dropped. Columns are then renormalised to sum 1, and a column without an entry of this size
        keeps its largest one; the paper says nothing about either.

        Returns:
            Sparse ``(B, N, M)``, coalesced; without gradients.
        """
        with torch.no_grad(), full_precision(self.keys.device.type):
            columns = self._columns()
            is_kept = columns >= threshold
            is_kept = is_kept.scatter_(2, columns.argmax(2, keepdim=True), True)
            values = columns.where(is_kept, 0.0)
            normalised = values / values.sum(2, keepdim=True)
            return normalised.mT.to_sparse()

    def leftmost(self, m: int) -> "SamplingMatrix":
        """Return the matrix of the first ``m`` columns, as FMOPS-Net takes them.

        Paper section "Flexible MOPS-Net for Arbitrary Ratios".
        """
        queries = self.queries[..., :m, :]
        return self._replace(queries=queries)

    def first_cloud(self) -> "SamplingMatrix":
        """Return the matrix of the first cloud, as a batch of one."""
        queries = self.queries
        if queries.ndim == 3:
            queries = queries[:1]
        return self._replace(queries=queries, keys=self.keys[:1])

    def nonzero_counts(self, threshold: float = 0.01) -> Tensor:
        """Count the entries of every column that reach ``threshold``.

        Returns:
            ``(B, M)`` in the dtype of the keys; without gradients.
        """
        with torch.no_grad():
            clouds = self.keys.shape[0]
            counts = self.keys.new_zeros(clouds, self.m)
            for cloud, _, columns, block in self._blocks():
                is_large = block >= threshold
                counts[cloud, columns] += is_large.sum(1)
            return counts

    def gram(self) -> Tensor:
        """Return SᵀS, which is the identity for an ideal sampling matrix (paper Eq. 2).

        Returns:
            ``(B, M, M)``; without gradients.
        """
        m = self.m
        with torch.no_grad(), full_precision(self.keys.device.type):
            clouds = self.keys.shape[0]
            result = self.keys.new_zeros(clouds, m, m)
            for cloud, _, _, block in self._blocks(block_queries=m):
                # SᵀS is symmetric: the part left of the diagonal is not computed.
                for part in slices(m, GRAM_ROWS):
                    from_diagonal = block[part.start :]
                    result[cloud, part, part.start :] += block[part] @ from_diagonal.mT
            return result.triu() + result.triu(1).mT

    def _columns(self) -> Tensor:
        """Return Sᵀ as ``(B, M, N)``: points last, so that the softmax runs along memory."""
        logits = (self.queries / self.tau) @ self.keys.mT
        return logits.softmax(-1)

    def _blocks(
        self, block_queries: int | None = None
    ) -> Iterator[tuple[int, slice, slice, Tensor]]:
        """Yield (cloud, rows, columns, block of Sᵀ) over all of S."""
        queries = self.queries / self.tau
        clouds, points_in_cloud, _ = self.keys.shape
        no_values = self.keys.new_zeros(clouds, points_in_cloud, 0)
        _, log_sum = attend_batch(queries, self.keys, no_values)
        size = blocks_on(queries.device)
        powers = per_cloud(queries * LOG2_E, clouds)
        for cloud, (power, keys) in enumerate(zip(powers, self.keys, strict=True)):
            for columns in slices(self.m, block_queries or size.queries):
                level = log_sum[cloud, columns]
                for rows in slices(points_in_cloud, size.points):
                    weights = softmax_weights(power[columns], keys[rows], level)
                    yield cloud, rows, columns, weights
