"""Rigid motions, represented by a unit quaternion and a translation.

Quaternions are ``(w, x, y, z)``, scalar first; q and −q are the same rotation. A motion maps a
point p to R·p + t. Angles are in radians unless stated otherwise.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Generator, Tensor

from mops_lightning.channels import PointChannels, coordinates, with_coordinates


class Motion(NamedTuple):
    """One rigid motion per cloud.

    Attributes:
        quaternion: ``(B, 4)``, scalar first, norm 1.
        translation: ``(B, 3)``, in units of the coordinates.
    """

    quaternion: Tensor
    translation: Tensor

    def apply(self, points: Tensor) -> Tensor:
        """Apply the motion to ``(B, N, 3)`` points."""
        rotation = quaternion_to_matrix(self.quaternion).to(points.dtype)
        return points @ rotation.mT + self.translation[:, None]

    def after(self, first: "Motion") -> "Motion":
        """Return the composition: ``first``, then this motion."""
        rotation = quaternion_multiply(self.quaternion, first.quaternion)
        moved = self.apply(first.translation[:, None])
        return Motion(rotation, translation=moved[:, 0])


def move(points: Tensor, motion: Motion, channels: PointChannels) -> Tensor:
    """Apply a motion to ``(B, N, 3 + C)`` points, whose normals turn with them."""
    moved = motion.apply(coordinates(points))
    if channels.normals is None:
        return with_coordinates(points, moved)
    rotation = quaternion_to_matrix(motion.quaternion).to(points.dtype)
    return with_coordinates(channels.rotated(points, rotation.mT), moved)


def identity_motion(points: Tensor) -> Motion:
    """Return the identity for every cloud of ``(B, N, 3)`` points."""
    translation = torch.zeros_like(points[:, 0])
    scalar = torch.ones_like(translation[:, :1])
    quaternion = torch.cat([scalar, translation], 1)
    return Motion(quaternion, translation)


def quaternion_conjugate(quaternion: Tensor) -> Tensor:
    """Return the inverse rotations of ``(..., 4)`` unit quaternions."""
    scalar, vector = quaternion.tensor_split((1,), -1)
    return torch.cat([scalar, -vector], -1)


def quaternion_multiply(left: Tensor, right: Tensor) -> Tensor:
    """Return the Hamilton product ``(..., 4)``: the rotation ``right``, then ``left``."""
    a, u = left.tensor_split((1,), -1)
    b, v = right.tensor_split((1,), -1)
    inner = (u * v).sum(-1, keepdim=True)
    cross = torch.linalg.cross(u, v)
    scalar = a * b - inner
    vector = a * v + b * u + cross
    return torch.cat([scalar, vector], -1)


def quaternion_to_matrix(quaternion: Tensor) -> Tensor:
    """Convert ``(..., 4)`` unit quaternions to ``(..., 3, 3)`` rotation matrices."""
    w, x, y, z = quaternion.unbind(-1)
    entries = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    rows = torch.stack(entries, -1)
    return rows.unflatten(-1, (3, 3))


def quaternion_from_euler(angles: Tensor) -> Tensor:
    """Convert ``(..., 3)`` angles about the fixed axes x, then y, then z to quaternions."""
    about_x = _about_axis(angles, 0)
    about_y = _about_axis(angles, 1)
    about_z = _about_axis(angles, 2)
    about_y_and_x = quaternion_multiply(about_y, about_x)
    return quaternion_multiply(about_z, about_y_and_x)


def _about_axis(angles: Tensor, axis: int) -> Tensor:
    """Return the quaternions ``(..., 4)`` of one of ``(..., 3)`` angles."""
    half = angles[..., axis] / 2
    shape = (*half.shape, 4)
    quaternion = torch.zeros(shape, dtype=angles.dtype, device=angles.device)
    quaternion[..., 0] = half.cos()
    quaternion[..., 1 + axis] = half.sin()
    return quaternion


def motion_of_vectors(turn: Tensor, shift: Tensor) -> Motion:
    """Return the motion that turns points about the origin and then shifts them.

    Args:
        turn: ``(B, 3)`` rotation vectors: the axis times the angle.
        shift: ``(B, 3)``.
    """
    angle = torch.linalg.vector_norm(turn, dim=1, keepdim=True)
    # sin(θ/2)/θ, by torch's sinc, which is sin(πx)/(πx) and 1 at 0
    sinc = torch.sinc(angle / (2 * torch.pi))
    vector = turn * sinc / 2
    scalar = (angle / 2).cos()
    return Motion(torch.cat([scalar, vector], 1), shift)


def rotation_angle(first: Tensor, second: Tensor) -> Tensor:
    """Return the geodesic angle between two rotations.

    The formula 2·atan2(‖v‖, |w|) for the relative rotation (w, v) is accurate near 0 and π, where
    the arc cosine of a rounded cosine loses half of its digits or returns NaN.

    Args:
        first: ``(..., 4)`` quaternions of any norm and sign.
        second: ``(..., 4)``, the same.

    Returns:
        ``(...)``, in radians from 0 to π.
    """
    between = quaternion_multiply(quaternion_conjugate(first), second)
    scalar = between[..., 0]
    vector = between[..., 1:]
    length = torch.linalg.vector_norm(vector, dim=-1)
    return 2 * torch.atan2(length, scalar.abs())


def random_motion(rotation: float, translation: float, generators: Sequence[Generator]) -> Motion:
    """Draw one random motion from each generator.

    Args:
        rotation: largest angle about each fixed axis, in degrees; angles are uniform.
        translation: largest translation along each axis, in units of the coordinates; uniform.
        generators: B generators, one per motion.

    Returns:
        B motions in float32.
    """
    numbers = [_six_numbers(generator) for generator in generators]
    drawn = 2 * torch.stack(numbers) - 1
    angles = torch.deg2rad(drawn[:, 0] * rotation)
    shifts = drawn[:, 1] * translation
    return Motion(quaternion_from_euler(angles).float(), shifts.float())


def _six_numbers(generator: Generator) -> Tensor:
    """Return numbers from 0 to 1, of shape (2, 3)."""
    return torch.rand(2, 3, generator=generator, dtype=torch.float64)
