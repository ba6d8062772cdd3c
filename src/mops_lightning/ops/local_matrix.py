"""Sampling matrices S with few entries in every column, stored as these entries."""

from typing import NamedTuple

import torch
from torch import Tensor

from mops_lightning.ops.local_attention import weighted_sums


class LocalMatrix(NamedTuple):
    """Sampling matrices S of a batch of clouds whose columns have k entries each.

    The views are those of ``SamplingMatrix``, at a cost that grows with M·k, not with N·M.

    Attributes:
        weights: ``(B, M, k)``, the entries of the columns: non-negative, with sum 1.
        rows: ``(B, M, k)`` int64, the points of the entries, all different in a column.
        number: N, of points of a cloud.

    Examples:
        >>> import torch
        >>> from mops_lightning.ops.local_matrix import LocalMatrix
        >>> matrix = LocalMatrix(torch.tensor([[[0.25, 0.75]]]), torch.tensor([[[2, 0]]]), 3)
        >>> matrix.dense()  # (B, N, M)
        tensor([[[0.7500],
                 [0.0000],
                 [0.2500]]])
        >>> matrix.sample(torch.tensor([[[4.0], [5.0], [8.0]]]))
        tensor([[[5.]]])
    """

    weights: Tensor
    rows: Tensor
    number: int

    @property
    def m(self) -> int:
        """Number of columns of S."""
        return self.weights.shape[1]

    @property
    def dtype(self) -> torch.dtype:
        """The type of the entries."""
        return self.weights.dtype

    def dense(self) -> Tensor:
        """Return S as ``(B, N, M)``."""
        clouds, m, _ = self.weights.shape
        columns = self.weights.new_zeros(clouds, m, self.number)
        return columns.scatter(2, self.rows, self.weights).mT

    def sample(self, points: Tensor) -> Tensor:
        """Return Q = SᵀP ``(B, M, V)`` of values ``(B, N, V)``, as ``SamplingMatrix.sample``."""
        return weighted_sums(self.weights, self.rows, points)

    def sparse(self, threshold: float = 0.01) -> Tensor:
        """Return S in coordinate (COO) format, as ``SamplingMatrix.sparse``."""
        with torch.no_grad():
            largest = self.weights.argmax(2, keepdim=True)
            is_kept = self.weights >= threshold
            is_kept = is_kept.scatter(2, largest, True)
            values = self.weights.where(is_kept, 0.0)
            values = values / values.sum(2, keepdim=True)
            places = is_kept.nonzero(as_tuple=True)
            cloud, column, _ = places
            indices = torch.stack([cloud, self.rows[places], column])
            shape = (len(values), self.number, self.m)
            entries = values[places]
            matrix = torch.sparse_coo_tensor(indices, entries, shape, check_invariants=False)
            return matrix.coalesce()

    def leftmost(self, m: int) -> "LocalMatrix":
        """Return the matrix of the first ``m`` columns."""
        weights = self.weights[:, :m]
        rows = self.rows[:, :m]
        return self._replace(weights=weights, rows=rows)

    def first_cloud(self) -> "LocalMatrix":
        """Return the matrix of the first cloud, as a batch of one."""
        weights = self.weights[:1]
        rows = self.rows[:1]
        return self._replace(weights=weights, rows=rows)

    def nonzero_counts(self, threshold: float = 0.01) -> Tensor:
        """Count the entries of every column that reach ``threshold``: ``(B, M)``."""
        with torch.no_grad():
            is_large = self.weights >= threshold
            return is_large.sum(2).to(self.weights.dtype)

    def gram(self) -> Tensor:
        """Return SᵀS ``(B, M, M)``, as ``SamplingMatrix.gram``."""
        with torch.no_grad():
            return self.products()

    def products(self) -> Tensor:
        """Return SᵀS ``(B, M, M)``; gradients flow to the weights.

        Only pairs of entries of one point are multiplied.
        """
        clouds, m, k = self.weights.shape
        cloud = torch.arange(clouds, device=self.rows.device)
        starts_of_clouds = cloud[:, None, None] * self.number
        points = (starts_of_clouds + self.rows).flatten()
        point, order = points.sort(stable=True)
        weights = self.weights.flatten()[order]
        columns = order // k  # counted through all clouds
        # Entry e of a point with g entries is in g pairs, with all entries from the point's first.
        sizes = torch.unique_consecutive(point, return_counts=True)[1]
        starts = sizes.cumsum(0) - sizes
        pairs = sizes.repeat_interleave(sizes)  # of every entry
        entries = torch.arange(len(point), device=point.device)
        entry = entries.repeat_interleave(pairs)
        first_pairs = (pairs.cumsum(0) - pairs).repeat_interleave(pairs)
        within = torch.arange(len(entry), device=point.device) - first_pairs
        first_entries = starts.repeat_interleave(sizes).repeat_interleave(pairs)
        other = first_entries + within
        places = columns[entry] * m + columns[other] % m
        products = weights[entry] * weights[other]
        result = weights.new_zeros(clouds * m * m)
        return result.index_add(0, places, products).view(clouds, m, m)
