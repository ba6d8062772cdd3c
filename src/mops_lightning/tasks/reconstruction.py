"""Reconstruction of dense clouds from sampled points.

Paper section "Reconstruction-oriented Downsampling".
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torchmetrics import MetricCollection

from mops_lightning.channels import coordinates
from mops_lightning.metrics import reconstruction
from mops_lightning.metrics.base import TableMetric, collection
from mops_lightning.ops.emd import earth_movers_distance
from mops_lightning.ops.nearest import chamfer_distance
from mops_lightning.tasks.base import K, Task, figures_of
from mops_lightning.types import Batch, TaskOutput

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TRAINED_BLOCK = 32
TRAINED_ROUNDS = 1
"""Blocks and rounds of the earth mover's distances in training; every published net had these."""
SCORED_BLOCK = 128
SCORED_ROUNDS = 8
"""Blocks and rounds of the earth mover's distances of clouds above ``exact_up_to``, in scores."""


class Reconstruction(Task):
    """Reconstructs clouds from their sampled points with an auto-encoder.

    The loss is the chamfer distance plus the earth mover's distance. In training the latter is
    computed by blocks (see ``ops.emd``), because exact matching would take most of the time. In
    scores it is exact up to ``exact_up_to`` points, and by larger blocks above.

    Args:
        net: maps ``(B, M, 3)`` points and a number n to ``(B, n, 3)``.
        exact_up_to: largest number of points for the exact distance in scores. None leaves the
            earth mover's distance out of the loss and of the scores. A training step then takes a
            half (auto-encoder) to a fifth (sampler) of the time.
    """

    score = reconstruction.NormalizedChamfer.name
    full_score = reconstruction.NormalizedChamfer.full_cloud_metric
    net_takes = ("points", "n_points")

    def __init__(self, net: nn.Module, exact_up_to: int | None = 2048) -> None:
        super().__init__(net)
        self.exact_up_to = exact_up_to

    def predict(self, batch: Batch, points: Tensor) -> Tensor:
        """Return reconstructions ``(B, N, 3)`` of the clouds from ``(B, M, 3)`` points."""
        return self.net(points, batch.points.shape[1])

    def disagreement(self, found: Tensor, reference: Tensor) -> Tensor:
        """Return the chamfer distance of two reconstructions."""
        return chamfer_distance(found, reference)

    def step(self, batch: Batch, points: Tensor) -> TaskOutput:
        """Reconstruct one batch for training.

        Args:
            batch: the clouds ``(B, N, 3)``.
            points: ``(B, M, 3)`` sampled from the clouds.

        Returns:
            The loss terms, and the distances of the reconstructions without a reference.
        """
        built = self.predict(batch, points)
        clouds = coordinates(batch.points)
        found = self._distances(built, clouds, TRAINED_BLOCK, TRAINED_ROUNDS)
        return TaskOutput(_means(found), found, None, built)

    def scores(self, batch: Batch, samples: Mapping[K, Tensor]) -> dict[K, TaskOutput]:
        """Return the distances of reconstructions from samples and, as targets, from all points."""
        clouds = coordinates(batch.points)
        block = None
        if clouds.shape[1] > (self.exact_up_to or 0):
            block = SCORED_BLOCK

        def scored(points: Tensor) -> reconstruction.Distances:
            built = self.predict(batch, points)
            return self._distances(built, clouds, block, SCORED_ROUNDS)

        full = scored(batch.points)
        outputs = {}
        for name, points in samples.items():
            found = scored(points)
            outputs[name] = TaskOutput(_means(found), found, full)
        return outputs

    def _distances(
        self, built: Tensor, clouds: Tensor, block: int | None, rounds: int
    ) -> reconstruction.Distances:
        """Return distances by cloud; that of the earth mover by one process per thread of torch."""
        # Before the other distance: gradients are summed in this order.
        chamfer = chamfer_distance(built, clouds)
        emd = None
        if self.exact_up_to is not None:
            emd = earth_movers_distance(built, clouds, block, rounds, torch.get_num_threads())
        return reconstruction.Distances(chamfer, emd)

    def metrics(self, training: bool = False) -> MetricCollection:
        """Return mean distances and, except in training, which has no reference, NRE."""
        metrics: list[TableMetric] = [reconstruction.MeanChamfer()]
        if not training:
            metrics.append(reconstruction.NormalizedChamfer())
            metrics.append(reconstruction.NormalizedChamferOfMeans())
        if self.exact_up_to is not None:
            metrics.append(reconstruction.MeanEMD())
            if not training:
                metrics.append(reconstruction.NormalizedEMD())
                metrics.append(reconstruction.NormalizedEMDOfMeans())
        return collection(*metrics)


def _means(distances: reconstruction.Distances) -> dict[str, Tensor]:
    """Return the loss terms: means over the clouds, by the name of the distance."""
    means = {}
    for name, values in distances._asdict().items():
        if values is not None:
            means[name] = values.mean()
    return means


@figures_of.register(Reconstruction)
def _(
    task: Reconstruction,
    batch: Batch,
    samples: Mapping[str, Tensor],
    titles: Sequence[str],
) -> "dict[str, Figure]":
    """Draw input, sampled points and reconstructions side by side."""
    from mops_lightning.viz.task_results import ReconstructionResult, reconstruction_grid

    clouds = coordinates(batch.points)
    full = task.predict(batch, batch.points)
    reference = chamfer_distance(full, clouds)
    columns = {}
    for name, chosen in samples.items():
        if chosen.shape == batch.points.shape:
            continue  # all points have a column of their own
        built = task.predict(batch, chosen)
        distances = chamfer_distance(built, clouds)
        ratios = (distances / reference).tolist()
        columns[name] = ReconstructionResult(coordinates(chosen), built, ratios)
    return {"reconstructions": reconstruction_grid(clouds, full, columns, titles)}
