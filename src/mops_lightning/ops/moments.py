"""Means and second moments of neighbourhoods."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from mops_lightning.ops import kernel_moments
from mops_lightning.ops.points import gather_points, zeros_if


def neighbourhood_moments(points: Tensor, centres: Tensor, rows: Tensor) -> Tensor:
    """Return the means of offsets o = p − c and of the products o·oᵀ.

    Args:
        points: ``(B, N, 3)``.
        centres: ``(B, M, 3)``, the points c.
        rows: ``(B, M, k)`` int64, the neighbours p of every centre.

    Returns:
        ``(B, M, 12)``: three means, then nine means of products; gradients flow to points and
        centres. On a CPU no ``(B, M, k, 3)`` tensor is made.
    """
    has_loops = points.device.type == "cpu" and points.dtype.itemsize >= 4
    if has_loops and not torch.compiler.is_compiling():
        moments: Tensor = _Moments.apply(
            points.contiguous(), centres.contiguous(), rows.contiguous()
        )
        return moments
    offsets = gather_points(points, rows) - centres[:, :, None]
    products = offsets.mT @ offsets / offsets.shape[2]
    return torch.cat([offsets.mean(2), products.flatten(2)], 2)


class _Moments(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, centres: Tensor, rows: Tensor) -> Tensor:
        ctx.save_for_backward(points, centres, rows)
        out = centres.new_empty(*centres.shape[:2], 12)
        arrays = (part.detach().numpy() for part in (points, centres, rows, out))
        kernel_moments.moments(*arrays)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor, None]:
        points, centres, rows = ctx.saved_tensors
        point_gradients = zeros_if(ctx.needs_input_grad[0], points)
        centre_gradients = torch.empty_like(centres)
        given = gradients[0].contiguous()
        parts = (given, points, centres, rows, point_gradients, centre_gradients)
        kernel_moments.moments_backward(*(part.detach().numpy() for part in parts))
        if not ctx.needs_input_grad[0]:
            return None, centre_gradients, None
        return point_gradients, centre_gradients, None
