"""Downsampling by the name of a method or of a model, to a number, a spacing or voxels.

Farthest points of an array are chosen without importing torch.
"""

from pathlib import Path
from typing import Any

import numpy as np

from mops_lightning.errors import UserError
from mops_lightning.samplers.budget import as_size, number_of
from mops_lightning.zoo import farthest


def downsample(
    points: Any,
    m: Any = None,
    method: str | Path = "fps",
    readout: str = "completed",
    batch: Any = None,
    start: int | str | None = None,
    seed: int | None = None,
    weight: Any = None,
    *,
    spacing: float | None = None,
    voxel: float | None = None,
    space: Any = None,
    tile: int | None = None,
    stratify: Any = None,
    stratify_min: int | None = None,
) -> tuple[Any, Any]:
    """Downsample clouds by a method or a model, or to a spacing or one point per voxel.

    Give exactly one of ``m``, ``spacing`` and ``voxel``. ``random``, ``serial``, ``fps`` and
    ``poisson`` choose among the given coordinates; other methods and models get every cloud in the
    unit sphere, as in training, and the result is mapped back.

    Args:
        points: ``(N, C)``, ``(B, N, C)``, or ``(P, C)`` with ``batch``; a tensor or an array, in
            any unit; or a list of ``(N, C)``, of several sizes. The first three columns are the
            coordinates. Further columns take no part in the choice, and stay with their points.
        m: number of points to return of each cloud, or a share of its points, a float below 1; a
            list holds one for each cloud.
        method: ``random``, ``serial``, ``voxel``, ``fps``, ``poisson``, ``normal_space``,
            ``covariance``, ``information`` or ``steady``, or what ``load`` takes, such as the name
            of a model. A model suits the task net and the shapes that it was trained for.
        readout: of a model: ``generated``, ``matched`` or ``completed``; see
            ``Sampler.downsample``. With ``voxel=``, ``generated`` returns the means of the voxels.
        batch: ``(P,)`` the cloud of every point, ascending from 0, as in PyTorch Geometric.
        start: with ``fps``, the row of the first point in every cloud, or ``"farthest"`` for the
            point farthest from the mean.
        seed: of random choices; None means 0.
        weight: one number of at least 0 per point, or ``"curvature"``; with ``random``, ``fps``,
            ``poisson``, completed sets, ``spacing`` and ``voxel``. Heavier points are preferred;
            points of weight 0 are left out. A list for a list of clouds. See
            ``Sampler.downsample``.
        spacing: a distance. No two points that are kept are nearer, and every point of the cloud
            has a kept one that is nearer. The result does not depend on the order of the points.
        voxel: side of cubic voxels, of which each occupied one keeps the point nearest to the mean
            of its points. The grid starts at 0.
        space: one factor per column: distances are those of the columns times these factors. With
            ``fps``, ``poisson`` and ``spacing``.
        tile: cut every cloud into tiles of up to so many points (a balanced kd-tree), and sample
            each, as in training.
        stratify: the class of every point, a whole number: ``(N,)``, ``(B, N)`` or ``(P,)``, a list
            for a list of clouds. Every class keeps its share of the m points, rounded by the
            largest remainder, and is sampled on its own. Rows are ascending.
        stratify_min: with ``stratify``, the number of points that every class keeps where it has
            them. Classes with larger shares give the points.

    Returns:
        The points, and their indices in the input, or None for generated points; tensors or arrays
        like the input. See ``Sampler.downsample`` for the shapes. For a list of clouds both are
        lists; so they are for ``(B, N, C)`` where clouds may keep different numbers of points:
        with a list as ``m``, ``spacing`` or ``voxel``. A cloud of a list with fewer than m points
        is returned whole.

    Raises:
        UserError: an argument is invalid, or there is no such method or model.

    Example:
        >>> import torch
        >>> from mops_lightning import downsample
        >>> points, indices = downsample(torch.rand(64, 3), 8)
        >>> points.shape, indices.shape
        (torch.Size([8, 3]), torch.Size([8]))
        >>> points, indices = downsample(torch.rand(1000, 6), voxel=0.5)
        >>> points.shape
        torch.Size([8, 6])
    """
    _check_budgets(m, spacing, voxel)
    if start is not None and (method != "fps" or m is None):
        raise UserError(f"start is for method='fps', got method={str(method)!r}.")
    _check_strata(m, stratify, stratify_min)
    if m is not None and not isinstance(m, list | tuple):
        m = as_size(m)
    is_simple = space is None and tile is None and stratify is None
    is_unweighted_fps = method == "fps" and readout == "completed" and weight is None
    if is_simple and is_unweighted_fps and batch is None:
        sample = farthest.downsample(points, m, seed or 0, start)
        if sample is not None:
            return sample
    from mops_lightning.zoo.by_distance import to_distance
    from mops_lightning.zoo.by_number import Choice, to_number
    from mops_lightning.zoo.find_sampler import find_sampler

    if m is None:
        return to_distance(points, method, readout, batch, seed or 0, weight, spacing, voxel, space)
    if is_simple and _is_plain(points, m, batch):
        number = number_of(m, points.shape[-2])
        sampler = find_sampler(method, number, points, start, seed)
        return sampler.downsample(points, number, readout, batch, weight)
    choice = Choice(method, readout, start, seed, space, tile)
    return to_number(points, m, batch, weight, choice, stratify, stratify_min)


def _check_strata(m: Any, stratify: Any, stratify_min: Any) -> None:
    if stratify is None and stratify_min is not None:
        raise UserError("stratify_min needs stratify, the class of every point.")
    if stratify is not None and m is None:
        raise UserError("stratify shares m points among classes: no spacing or voxel.")


def _check_budgets(m: Any, spacing: Any, voxel: Any) -> None:
    given = {"m": m, "spacing": spacing, "voxel": voxel}
    chosen = [name for name, value in given.items() if value is not None]
    if len(chosen) != 1:
        got = " and ".join(chosen) or "none of them"
        raise UserError(f"give m, spacing or voxel, got {got}.")


def _is_plain(points: Any, m: Any, batch: Any) -> bool:
    """Return whether the points are what ``Sampler.downsample`` takes."""
    if not hasattr(points, "dtype") or not hasattr(points, "shape"):
        return False
    is_share = isinstance(m, float)
    if isinstance(m, list | tuple) or (is_share and batch is not None):
        return False
    if isinstance(points, np.ndarray):
        is_floating = points.dtype.kind == "f"
    else:
        is_floating = points.is_floating_point()
    return is_floating and len(points.shape) in (2, 3) and points.shape[-1] == 3
