"""Distances between clouds and their reconstructions, over all shapes of a test."""

from typing import Any, ClassVar, Literal, NamedTuple

import torch
from torch import Tensor

from mops_lightning.metrics.base import MeanOverClouds, TableMetric


class Distances(NamedTuple):
    """Distances of reconstructions from their clouds, one of each kind per cloud.

    Attributes:
        chamfer: ``(B,)``, see ``ops.nearest.chamfer_distance``.
        emd: ``(B,)``, see ``ops.emd.earth_movers_distance``; None where it was left out.
    """

    chamfer: Tensor
    emd: Tensor | None


Kind = Literal["chamfer", "emd"]


class MeanDistance(MeanOverClouds):
    """Mean over all clouds of the distance between a cloud and its reconstruction.

    Attributes:
        kind: which distance.
    """

    kind: ClassVar[Kind]
    higher_is_better = False

    def update(self, distances: Distances, reference: Distances | None) -> None:
        """Add a batch; the reference is not used."""
        self.add(getattr(distances, self.kind).detach())


class MeanChamfer(MeanDistance):
    """Mean chamfer distance, in squared units of the coordinates."""

    name = "chamfer"
    kind = "chamfer"
    summary_order = 3


class MeanEMD(MeanDistance):
    """Mean earth mover's distance, in units of the coordinates."""

    name = "emd"
    kind = "emd"
    summary_order = 4


class NormalizedError(TableMetric):
    """Normalized reconstruction error: a distance divided by the full cloud's distance.

    NRE(Q, P) = D(P, F(Q)) / D(P, F(P)), paper section "Reconstruction of small-scale point clouds".
    1 means that the sampled points serve the net as well as all points.

    Attributes:
        kind: which distance D is.
        of_means: False takes the mean over clouds of their ratios, as the paper does; True the
            ratio of the mean distances, which a single cloud with a tiny D(P, F(P)) cannot
            dominate.
    """

    kind: ClassVar[Kind]
    of_means: ClassVar[bool] = False
    higher_is_better = False
    ratios: Tensor
    sampled: Tensor
    full: Tensor
    clouds: Tensor

    def __init__(self, **extra: Any) -> None:
        super().__init__(**extra)
        zero = torch.tensor(0.0).double()
        for state in ("ratios", "sampled", "full", "clouds"):
            self.add_state(state, default=zero.clone(), dist_reduce_fx="sum")

    def update(self, distances: Distances, reference: Distances) -> None:
        """Add distances of a batch, and the distances of the full clouds' reconstructions."""
        sampled = getattr(distances, self.kind).detach().double()
        full = getattr(reference, self.kind).detach().double()
        # 0/0, an exact reconstruction from sampled points too, counts as 1.
        ratios = torch.where(sampled == full, 1.0, sampled / full)
        self.ratios += ratios.sum()
        self.sampled += sampled.sum()
        self.full += full.sum()
        self.clouds += len(sampled)

    def compute(self) -> Tensor:
        """Return the mean ratio or the ratio of means over all clouds so far."""
        if self.of_means:
            value = self.sampled / self.full
        else:
            value = self.ratios / self.clouds
        return value.float()


class NormalizedChamfer(NormalizedError):
    """NRE by the chamfer distance."""

    name = "nre_cd"
    kind = "chamfer"
    summary_order: ClassVar[int | None] = 1
    full_cloud_metric = MeanChamfer.name


class NormalizedEMD(NormalizedError):
    """NRE by the earth mover's distance."""

    name = "nre_emd"
    kind = "emd"
    summary_order: ClassVar[int | None] = 2
    full_cloud_metric = MeanEMD.name


class NormalizedChamferOfMeans(NormalizedChamfer):
    """NRE by the chamfer distance, as a ratio of means."""

    name = "nre_cd_of_means"
    of_means = True
    summary_order = None


class NormalizedEMDOfMeans(NormalizedEMD):
    """NRE by the earth mover's distance, as a ratio of means."""

    name = "nre_emd_of_means"
    of_means = True
    summary_order = None
