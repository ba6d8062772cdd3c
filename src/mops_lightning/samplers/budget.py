"""How much of a cloud to keep: a number of points, a share, a spacing, or the size of voxels."""

from math import floor, inf
from typing import Any

import numpy as np

from mops_lightning.errors import UserError
from mops_lightning.ops.scalars import is_real_number, is_whole_number, python_number

Size = int | float
"""Points to keep: their number, or a share above 0 and below 1."""


def as_size(m: Any) -> Size:
    """Return the number of points, or their share, that a user gives.

    Args:
        m: a whole number of Python, NumPy or torch, or a float below 1.

    Raises:
        UserError: it is neither.
    """
    number = python_number(m)
    is_number = is_real_number(number)
    is_whole = is_whole_number(number)
    if is_whole and number >= 1:
        return int(number)
    if is_number and not is_whole and 0 < number < 1:
        return float(number)
    hint = ""
    if number == 1:
        hint = " One point is m=1, all points need no sampling."
    raise UserError(
        "m must be a whole number of at least 1, or a share of the points above 0 and below 1, "
        f"such as 0.1, got {m!r:.99}.{hint}"
    )


def number_of(size: Size, points: int) -> int:
    """Return how many of so many points to keep; a share is rounded, to one point at least."""
    if isinstance(size, int):
        return size
    return max(floor(size * points + 0.5), 1)


def check_distance(name: str, value: Any) -> float:
    """Return a distance above 0.

    Raises:
        UserError: it is none.
    """
    is_number = isinstance(value, int | float | np.number)
    is_number = is_number and not isinstance(value, bool)
    if not is_number or not 0 < float(value) < inf:
        raise UserError(f"{name} must be a number above 0, in the unit of the points, got {value}.")
    return float(value)


def check_scales(space: Any, columns: int) -> list[float]:
    """Return the factors of the columns in distances.

    Args:
        space: one number of at least 0 for every column; 0 leaves the column out.
        columns: how many columns the points have.

    Raises:
        UserError: these are other numbers, or all of them are 0.
    """
    scales = np.empty(0)
    if _are_numbers(space):
        scales = np.array(space, np.float64)
    is_one_each = scales.shape == (columns,)
    are_factors = np.isfinite(scales).all() and (scales >= 0).all()
    if not is_one_each or not are_factors or not scales.any():
        raise UserError(
            f"space must hold a factor of at least 0 for each of the {columns} columns, such as "
            f"(1, 1, 1, 0.5), got {space!r:.99}."
        )
    return scales.tolist()


def _are_numbers(space: Any) -> bool:
    is_list = isinstance(space, list | tuple | np.ndarray)
    return is_list and all(isinstance(scale, int | float | np.number) for scale in space)
