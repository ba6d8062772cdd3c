"""EdgeConv features: layers that also see the neighbours of every point.

The paper extracts features by pointwise layers and allows for any other extractor (section "Feature
Extraction"). EdgeConv is of Wang et al., "Dynamic Graph CNN", TOG 2019.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal, get_args

import torch
from torch import Tensor, nn

from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.nets.layers import PointMLP
from mops_lightning.ops.maxima import max_of_rows
from mops_lightning.ops.nearest import k_nearest
from mops_lightning.ops.precision import pointwise_autocast

Extractor = Literal["pointwise", "edgeconv"]
EXTRACTORS = get_args(Extractor)


class EdgeMLP(PointMLP):
    """Pointwise layers of which the first are EdgeConv layers.

    These compute relu(BN(A·x_i + max_j B·(x_j − x_i))). A is the weight of the pointwise layer. j
    runs over the k references nearest to point i in space, the same in every layer; references are
    evenly chosen rows of the cloud, all of them if there are not more. As only B·x_j depends on j,
    no tensor of all edges is made.

    Args:
        channels: input size, then the output size of every layer.
        depth: largest number of EdgeConv layers.
        k: number of neighbours.
        references: number of points that can be neighbours.
    """

    def __init__(
        self, channels: Sequence[int], depth: int = 3, k: int = 16, references: int = 256
    ) -> None:
        super().__init__(channels)
        self.k = k
        self.references = references
        sizes = pairwise(channels[: depth + 1])
        self.edges = nn.ModuleList(nn.Linear(*pair, bias=False) for pair in sizes)

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(B, N, channels[0])`` coordinates to features ``(B, N, channels[-1])``."""
        n = features.shape[1]
        count = min(n, self.references)
        chosen = torch.arange(count, device=features.device) * n // count
        with torch.no_grad():
            neighbours = k_nearest(features, features[:, chosen], min(self.k, count))[1]
        rows = features.to(next(self.parameters()))
        layers = list(self.layers)
        for edge in self.edges:
            linear, norm, relu = layers[:3]
            mapped = edge(rows)  # B·x
            edges = linear(rows) - mapped + max_of_rows(mapped[:, chosen], neighbours)
            rows = relu(norm(edges.flatten(0, 1))).unflatten(0, rows.shape[:2])
            layers = layers[3:]
        with pointwise_autocast(rows.device.type):
            return nn.Sequential(*layers)(rows.flatten(0, 1)).unflatten(0, rows.shape[:2])


def feature_layers(channels: Sequence[int], features: Extractor) -> PointMLP:
    """Return the layers that extract features: an ``EdgeMLP`` or a ``PointMLP``.

    Args:
        channels: input size, then the output size of every layer.
        features: ``edgeconv`` or ``pointwise``.

    Raises:
        UserError: another name.
    """
    if features not in EXTRACTORS:
        hint = did_you_mean(features, EXTRACTORS)
        raise UserError(f"features: unknown {features!r}.{hint}")
    return (EdgeMLP if features == "edgeconv" else PointMLP)(channels)
