"""Compressed Gaussian splats, read by gsply, an extra: .spz and SuperSplat's .ply."""

from pathlib import Path
from typing import Any

import numpy as np

from mops_lightning.data.formats.guard import BadCloudError
from mops_lightning.data.formats.isolated import isolated
from mops_lightning.data.formats.table import Column, Form, Table
from mops_lightning.errors import UserError


def read_spz(path: Path) -> Table:
    """Read an SPZ file with the columns of a splat's PLY file: opacities are logits, scales logs.

    Raises:
        UserError: gsply is not installed, or the file is broken.
    """
    return isolated(_parse_spz, path, compiles=True)


def read_compressed_ply(path: Path) -> Table:
    """Read a compressed PLY file of SuperSplat, with the columns of a plain one.

    Raises:
        UserError: gsply is not installed, or the file is broken.
    """
    return isolated(_parse_ply, path, compiles=True)


def refuse_splat(path: Path) -> Table:
    """Refuse a .splat file: no library that is kept up reads it.

    Raises:
        BadCloudError: always.
    """
    raise BadCloudError(
        f"{path}: .splat is not read. Convert it by SuperSplat, or npx @playcanvas/splat-transform "
        f"{path.name} {path.stem}.ply"
    )


def _parse_spz(path: Path) -> Table:
    return _table(_gsply(path).read_spz(path))


def _parse_ply(path: Path) -> Table:
    return _table(_gsply(path).plyread(path))


def _table(splats: Any) -> Table:
    columns: dict[str, Column] = {}
    columns |= _numbered("f_dc", splats.sh0)
    if splats.shN is not None and splats.shN.size:
        # In PLY, all coefficients of red come first, then those of green and blue.
        by_channel = np.asarray(splats.shN).transpose(0, 2, 1)
        columns |= _numbered("f_rest", by_channel.reshape(len(by_channel), -1))
    columns["opacity"] = np.array(splats.opacities).reshape(-1)
    columns |= _numbered("scale", splats.scales)
    columns |= _numbered("rot", splats.quats)
    points = np.array(splats.means)
    return Table(points.astype(np.float64), columns, form=Form(points.dtype))


def _numbered(name: str, values: Any) -> dict[str, Column]:
    array = np.array(values)
    return {f"{name}_{place}": array[:, place] for place in range(array.shape[1])}


def _gsply(path: Path) -> Any:
    """Return gsply, or raise an error that says how to install it."""
    try:
        import gsply
    except ModuleNotFoundError:
        raise UserError(
            f"{path}: compressed splats need gsply: pip install 'mops-lightning[splats]'."
        ) from None
    return gsply
