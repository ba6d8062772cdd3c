"""Logits and means of columns that choose among a few points each."""

from typing import Any

import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.autograd.function import once_differentiable

from mops_lightning.ops import kernel_local
from mops_lightning.ops.nearest import k_nearest
from mops_lightning.ops.points import gather_points

TREE_MIN_WORK = 2**22
"""Number of distances in a cloud from which a tree finds neighbours faster than all distances."""


def chosen_products(queries: Tensor, keys: Tensor, places: Tensor) -> Tensor:
    """Return the products of every query with its own few keys.

    Args:
        queries: ``(B, M, C)``.
        keys: ``(B, K, C)``.
        places: ``(B, M, k)`` int64, rows of the keys.

    Returns:
        ``(B, M, k)``; gradients flow to queries and keys. On a CPU no ``(B, M, k, C)`` copy of the
        keys is made.
    """
    if not _has_loops(queries):
        return (gather_points(keys, places) @ queries[..., None])[..., 0]
    return _ChosenProducts.apply(queries.contiguous(), keys.contiguous(), places.contiguous())


def weighted_sums(weights: Tensor, rows: Tensor, values: Tensor) -> Tensor:
    """Return sums of chosen rows, each with its weight.

    Args:
        weights: ``(B, M, k)``.
        rows: ``(B, M, k)`` int64, rows of the values.
        values: ``(B, N, V)``.

    Returns:
        ``(B, M, V)``; gradients flow to weights and values. On a CPU no ``(B, M, k, V)`` copy of
        the values is made.
    """
    if not _has_loops(weights):
        return (weights[:, :, None] @ gather_points(values, rows))[:, :, 0]
    return _WeightedSums.apply(weights.contiguous(), rows.contiguous(), values.contiguous())


def _has_loops(values: Tensor) -> bool:
    """Return whether compiled loops take the values: on a CPU, of 32 bits at least."""
    on_cpu = values.device.type == "cpu" and not torch.compiler.is_compiling()
    return on_cpu and values.dtype.itemsize >= 4


class _WeightedSums(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weights: Tensor, rows: Tensor, values: Tensor) -> Tensor:
        ctx.save_for_backward(weights, rows, values)
        out = values.new_empty(*weights.shape[:2], values.shape[2])
        arrays = (part.detach().numpy() for part in (weights, rows, values, out))
        for cloud in zip(*arrays, strict=True):
            kernel_local.sums(*cloud)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, Tensor]:
        weights, rows, values = ctx.saved_tensors
        weight_gradients = torch.zeros_like(weights)
        value_gradients = torch.zeros_like(values)
        given = gradients[0].contiguous()
        parts = (given, weights, rows, values, weight_gradients, value_gradients)
        for cloud in zip(*(part.detach().numpy() for part in parts), strict=True):
            kernel_local.sums_backward(*cloud)
        return weight_gradients, None, value_gradients


class _ChosenProducts(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, queries: Tensor, keys: Tensor, places: Tensor) -> Tensor:
        ctx.save_for_backward(queries, keys, places)
        out = queries.new_empty(places.shape)
        arrays = (part.detach().numpy() for part in (queries, keys, places, out))
        for cloud in zip(*arrays, strict=True):
            kernel_local.products(*cloud)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:
        queries, keys, places = ctx.saved_tensors
        query_gradients = torch.zeros_like(queries)
        key_gradients = torch.zeros_like(keys)
        parts = (gradients[0].contiguous(), queries, keys, places, query_gradients, key_gradients)
        for cloud in zip(*(part.detach().numpy() for part in parts), strict=True):
            kernel_local.products_backward(*cloud)
        return query_gradients, key_gradients, None


def nearest_rows(queries: Tensor, points: Tensor, k: int) -> Tensor:
    """Return the rows ``(B, M, k)`` of the k nearest points of every query, nearest first.

    In a tie, the lowest row comes first; where a tree is used, one of the tied rows does.

    Args:
        queries: ``(B, M, 3)``.
        points: ``(B, N, 3)``.
        k: number of points, at most N.
    """
    queries, points = queries.detach(), points.detach()
    if torch.compiler.is_exporting():
        return _nearest_in_graph(queries, points, k)
    work = queries.shape[1] * points.shape[1]
    on_cpu = points.device.type == "cpu" and not torch.compiler.is_compiling()
    if not on_cpu or work < TREE_MIN_WORK:
        return k_nearest(queries, points, k)[1]
    found = []
    for query, cloud in zip(queries.numpy(), points.numpy(), strict=True):
        _, rows = cKDTree(cloud, balanced_tree=False).query(query, k)
        found.append(torch.from_numpy(rows).view(len(query), k))
    return torch.stack(found)


def _nearest_in_graph(queries: Tensor, points: Tensor, k: int) -> Tensor:
    """Find the k nearest rows ``(B, M, k)`` by operations that do not depend on the sizes."""
    squares = torch.zeros_like(queries[..., :1])
    for axis in range(queries.shape[2]):
        apart = queries[:, :, None, axis] - points[:, None, :, axis]
        squares = squares + apart.square()
    return squares.topk(k, largest=False)[1]
