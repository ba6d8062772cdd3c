"""The few test clouds that a run saves with its pictures, for 3-D views in reports."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mops_lightning.errors import UserError
from mops_lightning.filesystem import atomic_write, load_npz

if TYPE_CHECKING:  # reports, which import this module, do not wait for torch
    from torch import Tensor

CLOUDS = "clouds.npz"
INPUT = "input"
TITLES = "titles"
MAX_INPUT_POINTS = 8192
"""Most input points saved of a cloud; all samples are saved."""


def save_clouds(
    path: Path, points: "Tensor", sampled: "Mapping[str, Tensor]", titles: Sequence[str]
) -> None:
    """Write clouds and their samples.

    Args:
        path: the file.
        points: ``(K, N, 3)`` input, y up.
        sampled: ``(K, M, 3)`` by readout.
        titles: one per cloud.
    """
    thinned = points[:, :: -(-points.shape[1] // MAX_INPUT_POINTS)]
    clouds = {INPUT: thinned, **sampled}
    arrays = {name: cloud.detach().cpu().float().numpy() for name, cloud in clouds.items()}
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **{TITLES: np.array(titles)}, **arrays)


def load_clouds(path: Path) -> tuple[list[str], dict[str, NDArray[np.float32]]]:
    """Read a file of ``save_clouds``.

    Returns:
        The titles, and ``(K, points, 3)`` by name, ``input`` first.

    Raises:
        UserError: the file is missing or not of this format.
    """
    try:
        arrays = load_npz(path)
    except UserError as error:
        raise UserError(f"{path}: cannot read saved clouds: {error}") from None
    titles = arrays.pop(TITLES, np.zeros(()))
    clouds = {name: arrays[name] for name in (INPUT, *arrays) if name in arrays}
    shapes = [a.shape for a in clouds.values() if a.dtype.kind == "f" and a.ndim == 3]
    right = len(shapes) == len(clouds) > 1 and titles.ndim == 1 and len(titles) > 0
    if INPUT not in clouds or not right:
        raise UserError(f"{path}: cannot read saved clouds: arrays of other names or shapes.")
    for name, cloud in clouds.items():
        if len(cloud) != len(titles) or not cloud.shape[1] or cloud.shape[2] != 3:
            raise UserError(f"{path}: cannot read saved clouds: {name} has shape {cloud.shape}.")
        if not np.isfinite(cloud).all():
            raise UserError(f"{path}: cannot read saved clouds: {name} is not finite.")
    try:
        return [str(title) for title in titles], clouds
    except SystemError:  # numpy's, for characters that do not exist
        raise UserError(f"{path}: cannot read saved clouds: damaged titles.") from None
