"""The sampler that the name of a method or of a model means."""

from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

import mops_lightning
from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.samplers.base import Sampler
from mops_lightning.zoo import addresses, names, weights
from mops_lightning.zoo.load import load


def find_sampler(
    method: str | Path,
    m: int,
    points: Any,
    start: int | str | None,
    seed: int | None,
) -> Sampler:
    """Return the sampler of a method, or of a model on the device of the points."""
    name = str(method)
    if method not in names.UNTRAINED:
        device = getattr(points, "device", "cpu")
        return _model(name, str(device))
    if start is None:
        return untrained(name, m, seed or 0)
    return untrained(name, m, seed or 0, start=start)


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
    is_file = Path(name).expanduser().exists()
    is_known = name in known or addresses.is_address(name) or is_file
    if not name or not is_known:
        hint = did_you_mean(name, known)
        raise UserError(f"method: unknown {name!r}.{hint}")
    path = weights.of_run(names.resolve(name))
    if not path.is_file():
        raise UserError(f"method: {name!r} holds no weights: there is no {path}.")
    changed = path.stat().st_mtime_ns
    return _loaded(path, changed, device)


@lru_cache(maxsize=4)
def _loaded(path: Path, changed: int, device: str) -> Sampler:
    """Load a sampler; a file that has changed since is loaded again."""
    return load(path).to(torch.device(device))
