"""Downsampling as a transform of PyTorch Geometric's data and of dictionaries."""

import copy
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from mops_lightning.errors import UserError
from mops_lightning.zoo.methods import downsample

try:
    with warnings.catch_warnings():  # it uses functions that torch has deprecated
        warnings.simplefilter("ignore")
        from torch_geometric.transforms import BaseTransform
except ModuleNotFoundError:  # dictionaries need none of it
    BaseTransform = object


class Downsample(BaseTransform):
    """Downsample a cloud together with what belongs to its points.

    Of a ``torch_geometric.data.Data`` or ``Batch``, all node attributes follow the selected points.
    Of a dictionary, as in MONAI, those arrays and tensors follow that have as many rows as there
    are points, or those that ``attributes`` names; everything else is kept. The input is not
    changed. A model is loaded with the first cloud, once per process.

    Args:
        m: number of points to keep of each cloud.
        method: a method or a model, see ``mops_lightning.downsample``.
        readout: of a model: ``completed``, ``matched`` or, without attributes, ``generated``.
        points: the key of the coordinates ``(N, 3)`` in a dictionary.
        attributes: keys of a dictionary that follow the points; None: all with N rows.
        start: with ``fps``, the row of the first point, or ``"farthest"``; see ``FPSSampler``.
        seed: of random choices; None means 0.

    Raises:
        UserError: the data have no points, edges or faces that would become invalid, or an
            argument that ``downsample`` refuses.

    Example:
        >>> import torch
        >>> from mops_lightning.transforms import Downsample
        >>> data = {"pos": torch.rand(64, 3), "normals": torch.rand(64, 3), "label": 5}
        >>> small = Downsample(8, method="fps")(data)
        >>> small["pos"].shape, small["normals"].shape, small["label"]
        (torch.Size([8, 3]), torch.Size([8, 3]), 5)
    """

    def __init__(
        self,
        m: int,
        method: str | Path = "fps",
        readout: str = "completed",
        points: str = "pos",
        attributes: Sequence[str] | None = None,
        start: int | str | None = None,
        seed: int | None = None,
    ) -> None:
        self.m = m
        self.method = method
        self.readout = readout
        self.points = points
        self.attributes = attributes
        self.start = start
        self.seed = seed

    def __call__(self, data: Any) -> Any:
        """Return the downsampled data; see the class."""
        return self._of_dict(data) if isinstance(data, Mapping) else self.forward(copy.copy(data))

    def forward(self, data: Any) -> Any:
        """Downsample PyTorch Geometric's data in place."""
        if hasattr(data, "to_data_list"):
            from torch_geometric.data import Batch

            return Batch.from_data_list([self(one) for one in data.to_data_list()])
        if getattr(data, "pos", None) is None:
            raise UserError(f"data must have points in pos, got {data!r:.100}.")
        for key in ("edge_index", "face"):
            if getattr(data, key, None) is not None:
                raise UserError(
                    f"data.{key} refers to points that are left out. Remove it first, or make it "
                    "after Downsample."
                )
        names = [key for key in data.keys() if key != "pos" and data.is_node_attr(key)]  # noqa: SIM118
        data.pos, rows = self._selected(data.pos, names)
        for key in names:
            data[key] = data[key][rows]
        if "num_nodes" in data:
            data.num_nodes = len(data.pos)
        return data

    def _of_dict(self, data: Mapping[str, Any]) -> dict[str, Any]:
        if self.points not in data:
            raise UserError(f"data must have points under {self.points!r}, got {list(data)}.")
        cloud = data[self.points]
        number = _rows_in(cloud)
        names = [
            key
            for key, value in data.items()
            if key != self.points and number is not None and _rows_in(value) == number
        ]
        if self.attributes is not None:
            self._check_attributes(data, [self.points, *names])
            names = [key for key in names if key in self.attributes]
        points, rows = self._selected(cloud, names)
        return {**data, self.points: points, **{key: data[key][rows] for key in names}}

    def _check_attributes(self, data: Mapping[str, Any], follow: Sequence[str]) -> None:
        """Refuse an attribute that cannot follow the points, as it has not one row for each."""
        for key in self.attributes or ():
            if key not in data:
                raise UserError(f"attributes: the data have no {key!r}, only {list(data)}.")
            if key not in follow:
                given = " ".join(repr(data[key]).split())
                raise UserError(
                    f"attributes: {key!r} must be an array or a tensor with a row for each point "
                    f"of {self.points!r}, got {given:.99}."
                )

    def _selected(self, points: Any, names: Iterable[str]) -> tuple[Any, Any]:
        """Return the points and rows of one cloud."""
        if getattr(points, "ndim", 2) != 2:
            raise UserError(f"points must have shape (N, 3), got {tuple(points.shape)}.")
        new, rows = downsample(
            points, self.m, self.method, self.readout, start=self.start, seed=self.seed
        )
        if rows is None and (first := next(iter(names), None)) is not None:
            raise UserError(
                f"{first!r} belongs to input points; readout='generated' makes new ones. Use "
                "readout='completed' or 'matched'."
            )
        return new, rows

    def __repr__(self) -> str:
        """Return the class with its main arguments."""
        return f"Downsample({self.m}, method={self.method!r}, readout={self.readout!r})"


def _rows_in(value: Any) -> int | None:
    """Return the number of rows of a tensor or an array; None for anything else."""
    return len(value) if isinstance(value, Tensor | np.ndarray) and value.ndim else None
