"""Channels of sampled points: those of the input points that they come from."""

import torch
from torch import Tensor

from mops_lightning.channels import coordinates
from mops_lightning.ops.nearest import nearest
from mops_lightning.ops.points import gather_points
from mops_lightning.types import SampleOutput


def with_carried(output: SampleOutput, points: Tensor) -> SampleOutput:
    """Give sampled points the channels that they lack.

    Args:
        output: of a sampler, whose points have coordinates only, or all channels.
        points: ``(B, N, 3 + C)`` its input.

    Returns:
        An output with ``(B, M, 3 + C)`` points. An input point keeps its channels; a generated
        point has those of the nearest input point.
    """
    sampled = output.points
    if sampled.shape[-1] == points.shape[-1]:
        return output
    rows = output.indices
    if rows is None:
        _, rows = nearest(sampled, coordinates(points))
    channels = gather_points(points[..., 3:], rows)
    return output._replace(points=torch.cat([sampled, channels], -1))
