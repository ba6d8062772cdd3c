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
        titles = [str(title) for title in arrays.pop(TITLES)]
        clouds = {INPUT: arrays.pop(INPUT), **arrays}
    except (UserError, KeyError, TypeError, SystemError) as error:  # numpy's, for odd characters
        raise UserError(f"{path}: cannot read saved clouds: {error}.") from None
    for name, cloud in clouds.items():
        fits = cloud.dtype.kind == "f" and cloud.shape[2:] == (3,) and cloud.shape[1] > 0
        if not fits or len(cloud) != len(titles) or not np.isfinite(cloud).all():
            raise UserError(f"{path}: cannot read saved clouds: {name} is damaged.")
    if len(clouds) < 2 or not titles:
        raise UserError(f"{path}: cannot read saved clouds: no samples.")
    return titles, clouds
