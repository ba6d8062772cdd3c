"""The few test clouds that a run saves with its pictures, for 3-D views in reports."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.errors import UserError
from mops_lightning.files import atomic_write, load_npz

CLOUDS = "clouds.npz"
INPUT = "input"
TITLES = "titles"
MAX_INPUT_POINTS = 8192
"""Most input points saved of a cloud; all samples are saved."""


def save_clouds(
    path: Path, points: Tensor, sampled: Mapping[str, Tensor], titles: Sequence[str]
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
    shapes = [a.shape for a in arrays.values() if a.dtype.kind == "f" and a.ndim == 3]
    right = len(shapes) == len(arrays) and all(s[0] == len(titles) and s[2] == 3 for s in shapes)
    if titles.ndim != 1 or INPUT not in arrays or not right:
        raise UserError(f"{path}: cannot read saved clouds: arrays of other names or shapes.")
    return [str(title) for title in titles], arrays
