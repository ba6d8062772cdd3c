"""Downsampling as a transform of PyTorch Geometric's data."""

import warnings
from pathlib import Path
from typing import Any

from mops_lightning.errors import UserError
from mops_lightning.zoo.downsample import downsample

with warnings.catch_warnings():  # it uses functions that torch has deprecated
    warnings.simplefilter("ignore")
    from torch_geometric.data import Batch
    from torch_geometric.transforms import BaseTransform


class Downsample(BaseTransform):
    """Downsample a ``torch_geometric.data.Data`` or ``Batch`` with all node attributes.

    The input is not changed. A model is loaded with the first cloud, once per process. Needs
    ``torch_geometric``.

    Args:
        m: number of points to keep of each cloud.
        method: a method or a model, see ``mops_lightning.downsample``.
        readout: of a model: ``completed``, ``matched`` or, without attributes, ``generated``.
        start: with ``fps``, the row of the first point, or ``"farthest"``; see ``FPSSampler``.
        seed: of random choices; None means 0.

    Raises:
        UserError: the data have no points, edges or faces that would become invalid, or an
            argument that ``downsample`` refuses.

    Example:
        >>> import torch
        >>> from torch_geometric.data import Data
        >>> from mops_lightning.transforms import Downsample
        >>> data = Data(pos=torch.rand(64, 3), normals=torch.rand(64, 3), y=torch.tensor([5]))
        >>> small = Downsample(8, method="fps")(data)
        >>> small.pos.shape, small.normals.shape, small.y
        (torch.Size([8, 3]), torch.Size([8, 3]), tensor([5]))
    """

    def __init__(
        self,
        m: int,
        method: str | Path = "fps",
        readout: str = "completed",
        start: int | str | None = None,
        seed: int | None = None,
    ) -> None:
        self.m = m
        self.method = method
        self.readout = readout
        self.start = start
        self.seed = seed

    def forward(self, data: Any) -> Any:
        """Downsample data in place; of a batch, cloud by cloud."""
        if isinstance(data, Batch):
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
        points, rows = downsample(
            data.pos, self.m, self.method, self.readout, start=self.start, seed=self.seed
        )
        if rows is None and names:
            raise UserError(
                f"{names[0]!r} belongs to input points; readout='generated' makes new ones. Use "
                "readout='completed' or 'matched'."
            )
        data.pos = points
        for key in names:
            data[key] = data[key][rows]
        if "num_nodes" in data:
            data.num_nodes = len(data.pos)
        return data

    def __repr__(self) -> str:
        """Return the class with its main arguments."""
        return f"Downsample({self.m}, method={self.method!r}, readout={self.readout!r})"
