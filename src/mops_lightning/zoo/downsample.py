"""Downsampling by the name of a method or of a model."""

from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

import mops_lightning
from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.samplers.base import Sampler
from mops_lightning.zoo import addresses, names, weights
from mops_lightning.zoo.load import load


def downsample(
    points: Any,
    m: int,
    method: str | Path = "fps",
    readout: str = "completed",
    batch: Any = None,
    start: int | str | None = None,
    seed: int | None = None,
    weight: Any = None,
) -> tuple[Any, Any]:
    """Downsample clouds by a method or a model.

    Clouds are moved into the unit sphere, as in training, and the result is mapped back.

    Args:
        points: ``(N, 3)``, ``(B, N, 3)``, or ``(P, 3)`` with ``batch``; a tensor or an array,
            floating point, in any unit.
        m: number of points to return of each cloud.
        method: ``random``, ``serial``, ``voxel``, ``fps`` or ``poisson``, or what ``load`` takes,
            such as the name of a model. A model suits the task net and the shapes that it was
            trained for.
        readout: of a model: ``generated``, ``matched`` or ``completed``; see
            ``Sampler.downsample``.
        batch: ``(P,)`` the cloud of every point, ascending from 0, as in PyTorch Geometric.
        start: with ``fps``, the row of the first point in every cloud, or ``"farthest"`` for the
            point farthest from the mean.
        seed: of random choices; None means 0.
        weight: one number of at least 0 per point, or ``"curvature"``; with ``random``, ``fps``,
            ``poisson`` and completed sets. See ``Sampler.downsample``.

    Returns:
        The points, and their indices in the input, or None for generated points; tensors or arrays
        like the input. See ``Sampler.downsample`` for the shapes.

    Raises:
        UserError: an argument is invalid, or there is no such method or model.

    Example:
        >>> import torch
        >>> from mops_lightning import downsample
        >>> points, indices = downsample(torch.rand(64, 3), 8)
        >>> points.shape, indices.shape
        (torch.Size([8, 3]), torch.Size([8]))
    """
    if start is not None and method != "fps":
        raise UserError(f"start is for method='fps', got method={str(method)!r}.")
    if method in names.UNTRAINED:
        arguments = {} if start is None else {"start": start}
        sampler = untrained(str(method), m, seed or 0, **arguments)
    else:
        sampler = _model(str(method), str(getattr(points, "device", "cpu")))
    return sampler.downsample(points, m, readout, batch, weight)


def untrained(method: str, m: int, seed: int = 0, **arguments: Any) -> Sampler:
    """Return the sampler of one of the ``UNTRAINED`` methods; some have no seed."""
    if method not in ("voxel", "serial"):
        arguments["seed"] = seed
    make: type[Sampler] = getattr(mops_lightning, names.UNTRAINED[method])
    return make(m, **arguments)


def _model(name: str, device: str) -> Sampler:
    """Return a model's sampler, which is loaded once.

    Raises:
        UserError: there is no such method or model.
    """
    known = {*names.UNTRAINED, *names.available()}
    exists = addresses.is_address(name) or Path(name).expanduser().exists()
    if name not in known and not exists:
        raise UserError(f"method: unknown {name!r}.{did_you_mean(name, known)}")
    path = weights.of_run(names.resolve(name))
    return _loaded(path, path.stat().st_mtime_ns, device)


@lru_cache(maxsize=4)
def _loaded(path: Path, changed: int, device: str) -> Sampler:
    """Load a sampler; a file that has changed since is loaded again."""
    return load(path).to(torch.device(device))
