"""Classification of sampled clouds (paper section "Classification-oriented Downsampling")."""

from torch import Tensor, nn
from torch.nn import functional as F
from torchmetrics import MetricCollection

from mops_lightning.errors import UserError
from mops_lightning.metrics.base import collection
from mops_lightning.metrics.classification import Accuracy, MeanClassAccuracy
from mops_lightning.tasks.base import Task
from mops_lightning.types import Batch, TaskOutput


def divergence(found: Tensor, reference: Tensor) -> Tensor:
    """Return KL(reference ‖ found) over the last dimension of logits ``(..., C)``: ``(...)``."""
    expected = reference.log_softmax(-1)
    difference = expected - found.log_softmax(-1)
    return (expected.exp() * difference).sum(-1)


class Classification(Task):
    """Classifies clouds from their sampled points.

    Args:
        net: maps ``(B, M, 3)`` points to ``(B, num_classes)`` logits.
        num_classes: number of classes.
        label_smoothing: share of a label that the cross entropy spreads over all classes.

    Raises:
        UserError: there are fewer than two classes, or ``label_smoothing`` is outside [0, 1).
    """

    score = Accuracy.name
    output_names = "class_names"

    def __init__(self, net: nn.Module, num_classes: int, label_smoothing: float = 0.0) -> None:
        super().__init__(net)
        if num_classes < 2:
            raise UserError(
                f"num_classes must be at least 2, got {num_classes}. Give data of more classes "
                "(dataset.classes)."
            )
        if not 0 <= label_smoothing < 1:
            raise UserError(f"label_smoothing must be in [0, 1), got {label_smoothing}.")
        self.num_classes = num_classes
        self.label_smoothing = label_smoothing

    def predict(self, batch: Batch, points: Tensor) -> Tensor:
        """Return the logits ``(B, num_classes)`` of ``(B, M, 3)`` points."""
        return self.net(points)

    def disagreement(self, found: Tensor, reference: Tensor) -> Tensor:
        """Return the Kullback-Leibler divergence KL(reference ‖ found) of the classes."""
        return divergence(found, reference)

    def step(self, batch: Batch, points: Tensor) -> TaskOutput:
        """Classify one batch.

        Args:
            batch: the clouds and their labels ``(B,)``.
            points: ``(B, M, 3)`` sampled from the clouds.

        Returns:
            The cross entropy, the losses of samplers inside the net, logits ``(B, num_classes)``
            and labels.
        """
        logits = self.predict(batch, points)
        loss = F.cross_entropy(logits, batch.labels, label_smoothing=self.label_smoothing)
        losses = {"cross_entropy": loss}
        losses |= getattr(self.net, "losses", {})
        return TaskOutput(losses, logits, batch.labels, logits)

    def metrics(self, training: bool = False) -> MetricCollection:
        """Return overall and mean class accuracy, both in [0, 1]."""
        accuracy = Accuracy(self.num_classes)
        return collection(accuracy, MeanClassAccuracy(self.num_classes))
