"""Registration of sampled clouds (paper section "Registration-oriented Downsampling")."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor, nn
from torchmetrics import MetricCollection

from mops_lightning.data.pairs import Pairs
from mops_lightning.losses.registration import quaternion_loss
from mops_lightning.metrics.base import collection
from mops_lightning.metrics.registration import (
    DoubledRotationError,
    RotationError,
    RotationErrorP90,
    RotationRecall5,
    RotationRecall10,
    TranslationError,
)
from mops_lightning.ops.rigid import Motion, identity_motion, quaternion_to_matrix
from mops_lightning.tasks.base import Task, figures_of
from mops_lightning.types import PairBatch, TaskOutput

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Registration(Task):
    """Estimates the rigid motion between two clouds from sampled points of both.

    Each cloud's centroid is subtracted before sampling; the predicted and scored translation
    applies to the original clouds.

    Args:
        net: maps sources ``(B, M, 3)`` and targets ``(B, M, 3)`` to a ``Motion``.
        resample: number of points of source and target, drawn independently; None uses all points
            of a cloud in both. See ``data.pairs.Pairs``.

    Raises:
        UserError: an argument is out of range.
    """

    score = RotationError.name
    net_takes = ("source", "target")
    clouds_per_prediction = 2
    maps_pooled = "from_pooled_pair"

    def __init__(self, net: nn.Module, resample: int | None = None) -> None:
        super().__init__(net)
        self.make_batch = Pairs(resample)

    def predict(self, batch: PairBatch, points: Tensor) -> Motion:
        """Return the motions between the centred clouds from ``(2B, M, 3)`` points of both."""
        return self.net(*points.chunk(2))

    def disagreement(self, found: Motion, reference: Motion) -> Tensor:
        """Return the squared distance of two motions.

        This is the sum over the unit axes of the squared distance between the rotated axes, plus
        the squared distance of the translations.
        """
        rotation = quaternion_to_matrix(found.quaternion)
        rotation = rotation - quaternion_to_matrix(reference.quaternion)
        translation = found.translation - reference.translation
        return rotation.square().sum((1, 2)) + translation.square().sum(1)

    def step(self, batch: PairBatch, points: Tensor) -> TaskOutput:
        """Register one batch.

        Args:
            batch: pairs.
            points: ``(2B, M, 3)`` sampled from ``batch.points``: sources, then targets.

        Returns:
            The loss terms, the predicted motions and the true ones.
        """
        found = self.predict(batch, points)
        true = Motion(batch.quaternion, batch.translation)
        from_source, from_target = batch.centroids.chunk(2)
        # The true motion between the centred clouds: R·(p + c) + t = R·p + (R·c + t).
        shift = true.apply(from_source[:, None])[:, 0] - from_target
        losses = quaternion_loss(found, true._replace(translation=shift))
        turned = found._replace(translation=from_target).apply(-from_source[:, None])[:, 0]
        predicted = Motion(found.quaternion, found.translation + turned)
        return TaskOutput(losses, predicted, true, found)

    def metrics(self, training: bool = False) -> MetricCollection:
        """Return rotation errors in degrees, recalls in [0, 1] and the translation error."""
        return collection(
            RotationError(),
            RotationErrorP90(),
            DoubledRotationError(),
            RotationRecall5(),
            RotationRecall10(),
            TranslationError(),
        )


@figures_of.register(Registration)
def _(
    task: Registration, batch: PairBatch, samples: Mapping[str, Tensor], titles: Sequence[str]
) -> "dict[str, Figure]":
    """Draw the pairs before and after alignment, one column for each readout."""
    from mops_lightning.viz.task_results import RegistrationResult, pair_grid

    source, target = batch.points.chunk(2)
    columns = {}
    for name, points in samples.items():
        result = task.step(batch, points)
        motion: Motion = result.output
        of_source, of_target = points.chunk(2)
        errors = RotationError.of(result.predictions, result.targets)
        columns[name] = RegistrationResult(
            motion.apply(source), motion.apply(of_source), of_target, errors.tolist()
        )
    true = Motion(batch.quaternion, batch.translation)
    before = RotationError.of(identity_motion(source), true).tolist()
    return {"pairs": pair_grid(source, target, before, columns, titles)}
