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
        shapes = {cloud.shape[::2] for cloud in clouds.values()}
        finite = all(np.isfinite(cloud).all() for cloud in clouds.values())
        if len(clouds) < 2 or not titles or shapes != {(len(titles), 3)} or not finite:
            raise ValueError("expected finite clouds and samples for each title")
    # Numpy raises TypeError for other kinds of numbers, SystemError for odd characters.
    except (KeyError, SystemError, TypeError, ValueError) as error:
        raise UserError(f"{path}: cannot read saved clouds: {error}.") from None
    return titles, clouds
