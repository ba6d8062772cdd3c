"""A frame of reference that turns with a cloud, made from its farthest points.

In registration, source and target are the same shape, turned. Features of coordinates differ
between the two, so a learned sampler chooses different places of the shape in both, and the pose
that is found from them suffers. Coordinates in a frame that turns with the cloud are the same in
both; so are features, the sampling matrix and the chosen places.
"""

import torch
from torch import Tensor
from torch.nn import functional as F

from mops_lightning.channels import PointChannels, coordinates, with_coordinates
from mops_lightning.ops.points import distance_dtype, gather_points
from mops_lightning.samplers.anchors import rows_from_mean

FRAME_POINTS = 4
"""Farthest points among which the axes are chosen."""

LEAST_WIDTH = 1e-5
"""Width of a cloud over its radius below which rounding errors would determine the second axis."""


def in_own_frame(points: Tensor, channels: PointChannels) -> Tensor:
    """Return clouds with their means at the origin, turned into their own frames.

    Args:
        points: ``(B, N, 3 + C)``.
        channels: of the points; normals turn with the cloud.
    """
    places = coordinates(points).to(distance_dtype(points))
    centred = places - places.mean(1, keepdim=True)
    axes = own_axes(centred)
    moved = with_coordinates(points, centred.to(points.dtype))
    return channels.rotated(moved, axes.to(points.dtype))


def own_axes(centred: Tensor) -> Tensor:
    """Return the axes of clouds ``(B, N, 3)`` as the columns of rotations ``(B, 3, 3)``.

    The first axis points to the point that is farthest from the mean. The second one points, at a
    right angle to it, to that of the next three farthest points which is farthest from the first
    axis. The third one makes the frame right-handed. For points on one line, the second
    and third axis are zero; for points in one place, all are.

    Args:
        centred: the coordinates, with their means at the origin.
    """
    rows = rows_from_mean(centred, FRAME_POINTS)[:, :FRAME_POINTS]
    farthest = gather_points(centred, rows)
    first = F.normalize(farthest[:, 0], dim=1)
    along = farthest @ first[:, :, None]
    aside = farthest - along * first[:, None]
    lengths = aside.norm(dim=2)
    widest = lengths.argmax(1, keepdim=True)
    second = F.normalize(gather_points(aside, widest)[:, 0], dim=1)
    radius = farthest[:, :1].norm(dim=2)
    is_known = lengths.gather(1, widest) > LEAST_WIDTH * radius
    second = torch.where(is_known, second, 0.0)
    third = torch.linalg.cross(first, second)
    return torch.stack([first, second, third], 2)
