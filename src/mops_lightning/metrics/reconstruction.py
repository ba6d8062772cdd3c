"""How well clouds are reconstructed, over all shapes of a test."""

from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torchmetrics import Metric


class Distances(NamedTuple):
    """Distances of reconstructions from their clouds, one of each kind per cloud.

    Attributes:
        chamfer: ``(B,)``, see ``losses.chamfer_distance``.
        emd: ``(B,)``, see ``emd.earth_movers_distance``.
    """

    chamfer: Tensor
    emd: Tensor


Kind = Literal["chamfer", "emd"]


class MeanDistance(Metric):
    """Mean over all clouds of the distance between a cloud and its reconstruction.

    Args:
        kind: which distance.
    """

    is_differentiable = False
    higher_is_better = False
    full_state_update = False
    total: Tensor
    clouds: Tensor

    def __init__(self, kind: Kind, **extra: Any) -> None:
        super().__init__(**extra)
        self.kind = kind
        self.add_state("total", default=torch.tensor(0.0), dist_reduce_fx="sum")
        self.add_state("clouds", default=torch.tensor(0), dist_reduce_fx="sum")

    def update(self, found: Distances, reference: Distances | None) -> None:
        """Take in a batch; the reference does not matter."""
        values = getattr(found, self.kind).detach()
        self.total += values.sum()
        self.clouds += len(values)

    def compute(self) -> Tensor:
        """Return the mean over all clouds so far."""
        return self.total / self.clouds


class NormalizedError(Metric):
    """Normalized reconstruction error: a distance against that of the full cloud's reconstruction.

    NRE(Q, P) = D(P, F(Q)) / D(P, F(P)), paper section "Reconstruction of small-scale point clouds".
    1 means that the sampled points serve the net as well as all points.

    Args:
        kind: which distance D is.
        of_means: False takes the mean over clouds of their ratios, as the paper does; True the
            ratio of the mean distances, which one cloud that is reconstructed very well cannot
            dominate.
    """

    is_differentiable = False
    higher_is_better = False
    full_state_update = False
    ratios: Tensor
    found: Tensor
    wanted: Tensor
    clouds: Tensor

    def __init__(self, kind: Kind, of_means: bool = False, **extra: Any) -> None:
        super().__init__(**extra)
        self.kind = kind
        self.of_means = of_means
        for name in ("ratios", "found", "wanted", "clouds"):
            self.add_state(name, default=torch.tensor(0.0).double(), dist_reduce_fx="sum")

    def update(self, found: Distances, reference: Distances) -> None:
        """Take in a batch of distances and those of the full clouds' reconstructions."""
        mine, full = (getattr(one, self.kind).detach().double() for one in (found, reference))
        # A cloud that is reconstructed exactly, from sampled points too, has a ratio of 1.
        self.ratios += torch.where(mine == full, 1.0, mine / full).sum()
        self.found += mine.sum()
        self.wanted += full.sum()
        self.clouds += len(mine)

    def compute(self) -> Tensor:
        """Return the mean ratio or the ratio of means over all clouds so far."""
        value = self.found / self.wanted if self.of_means else self.ratios / self.clouds
        return value.float()
