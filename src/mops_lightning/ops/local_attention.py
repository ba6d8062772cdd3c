"""Logits and means of columns that choose among a few points each."""

from typing import Any, NamedTuple

import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor
from torch.autograd.function import once_differentiable

from mops_lightning.ops import kernel_local
from mops_lightning.ops.nearest import k_nearest_rows
from mops_lightning.ops.points import gather_points, zeros_if

TREE_MIN_WORK = 2**22
"""Number of distances in a cloud from which a tree finds neighbours faster than all distances."""


class Entries(NamedTuple):
    """Where the columns of S have entries.

    Attributes:
        points: ``(B, K, 3)`` the candidates.
        anchors: ``(B, M)`` int64, the place of every column's anchor among the candidates.
        places: ``(B, M, k)`` int64, the candidates of every column.
    """

    points: Tensor
    anchors: Tensor
    places: Tensor


def column_weights(
    queries: Tensor, keys: Tensor, entries: Entries, sharpness: Tensor, tau: float
) -> Tensor:
    """Return columns of S: the softmax over the entries of (⟨w, h⟩ − sharpness · |p − a|²)/τ.

    Args:
        queries: ``(B, M, C)``, the vectors w of the columns.
        keys: ``(B, K, C)``, the vectors h of the candidates.
        entries: the candidates p of every column, and its anchor a.
        sharpness: ``(B, M)``.
        tau: the temperature τ.

    Returns:
        ``(B, M, k)``; gradients flow to queries, keys, points and sharpness. On a CPU no copies of
        keys or points are made for every entry.
    """
    points, anchors, places = entries
    if _has_loops(queries):
        floats = [part.contiguous() for part in (queries, keys, points, sharpness)]
        integers = [part.contiguous() for part in (anchors, places)]
        weights: Tensor = _ColumnWeights.apply(*floats, *integers, tau)
        return weights
    products = (gather_points(keys, places) @ queries[..., None])[..., 0]
    apart = gather_points(points, places) - gather_points(points, anchors)[:, :, None]
    logits = products - sharpness[..., None] * apart.square().sum(3)
    return (logits / tau).softmax(2)


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
        kernel_local.sums(*_arrays(weights, rows, values, out))
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, Tensor | None]:
        weights, rows, values = ctx.saved_tensors
        weight_gradients = torch.empty_like(weights)
        value_gradients = zeros_if(ctx.needs_input_grad[2], values)
        given = gradients[0].contiguous()
        parts = (given, weights, rows, values, weight_gradients, value_gradients)
        kernel_local.sums_backward(*_arrays(*parts))
        if not ctx.needs_input_grad[2]:
            return weight_gradients, None, None
        return weight_gradients, None, value_gradients


class _ColumnWeights(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        queries: Tensor,
        keys: Tensor,
        points: Tensor,
        sharpness: Tensor,
        anchors: Tensor,
        places: Tensor,
        tau: float,
    ) -> Tensor:
        weights = queries.new_empty(places.shape)
        floats = _arrays(queries, keys, points, sharpness)
        kernel_local.columns(*floats, *_arrays(anchors, places), tau, *_arrays(weights))
        ctx.save_for_backward(weights, queries, keys, points, sharpness, anchors, places)
        ctx.tau = tau
        return weights

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        weights, *inputs = ctx.saved_tensors
        queries, keys, points, sharpness, _, _ = inputs
        are_points_needed = ctx.needs_input_grad[2]
        query_gradients = torch.zeros_like(queries)
        key_gradients = torch.zeros_like(keys)
        point_gradients = zeros_if(are_points_needed, points)
        sharpness_gradients = torch.zeros_like(sharpness)
        written = (query_gradients, key_gradients, point_gradients, sharpness_gradients)
        kernel_local.columns_backward(
            *_arrays(gradients[0].contiguous(), weights, *inputs), ctx.tau, *_arrays(*written)
        )
        of_points = point_gradients if are_points_needed else None
        return query_gradients, key_gradients, of_points, sharpness_gradients, None, None, None


def _arrays(*parts: Tensor) -> list[NDArray[Any]]:
    """Return tensors as arrays of the same memory."""
    return [part.detach().numpy() for part in parts]


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
        return k_nearest_rows(queries, points, k)
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
