"""What every task offers to the experiment."""

from collections.abc import Callable, Mapping, Sequence
from inspect import signature
from typing import TYPE_CHECKING, Any

from torch import Generator, Tensor, nn
from torchmetrics import MetricCollection

from mops_lightning.errors import UserError
from mops_lightning.types import Batch, TaskOutput

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Task(nn.Module):
    """Base of all tasks: owns the task net, its losses and its metrics.

    Args:
        net: the task net; how it is called is the task's own affair.

    Raises:
        UserError: it is no net, or one of another task.
    """

    score: str
    """Name of the metric that tables show by default; see ``metrics.info.MetricInfo``."""

    full_score: str | None = None
    """Name of the metric that scores the task net on full clouds; None: ``score``."""

    requires_same_classes: bool = False
    """Whether the net's outputs are the data's classes, so that it fits no others."""

    net_takes: tuple[str, ...] = ("points",)
    """What the net's ``forward`` takes, by name."""

    test_seed: int = 0
    """Fixes what ``make_batch`` draws for the clouds that are scored."""

    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        if not isinstance(net, nn.Module):
            raise UserError(f"task.net must be a net, got {net!r}. Choose one with task/net=NAME.")
        takes = tuple(signature(net.forward).parameters)
        if takes != self.net_takes:
            raise UserError(
                f"task/net: {type(net).__name__} takes ({', '.join(takes)}) and "
                f"{type(self).__name__.lower()} needs a net that takes "
                f"({', '.join(self.net_takes)}). Leave task/net out for the task's own."
            )
        self.net = net

    def make_batch(self, batch: Batch, generators: Callable[[], list[Generator]]) -> Any:
        """Turn a batch of clouds into what ``step`` takes; the same by default.

        Args:
            batch: of the loader.
            generators: makes one for each cloud, which fixes what is drawn for it, whatever stands
                beside it in the batch.
        """
        return batch

    def points_of(self, n_points: int) -> int:
        """Return how many points the clouds have that are sampled, from the dataset's number."""
        return n_points

    def step(self, batch: Any, points: Tensor) -> TaskOutput:
        """Run the net on sampled points, for training.

        Args:
            batch: from ``make_batch``.
            points: ``(B', M, 3)`` sampled from ``batch.points``, in the same order.

        Returns:
            Loss terms, predictions and targets.
        """
        raise NotImplementedError

    def reference(self, batch: Any) -> Any:
        """Return what all scores of a batch are compared with; None by default."""
        return None

    def scored(self, batch: Any, points: Tensor, reference: Any = None) -> TaskOutput:
        """Run the net on sampled points, for scores; the same as ``step`` by default.

        Args:
            batch: from ``make_batch``.
            points: as for ``step``.
            reference: from ``reference(batch)``, which is the same for all readouts of a batch.

        Returns:
            Loss terms, predictions and targets.
        """
        return self.step(batch, points)

    def metrics(self, training: bool = False) -> MetricCollection:
        """Return new metrics that take predictions and targets of ``scored``.

        Args:
            training: take those of ``step`` instead.
        """
        raise NotImplementedError

    def cloud_titles(self, titles: Sequence[str]) -> list[str]:
        """Return a title for each of a batch's points, from those of the dataset's clouds."""
        return list(titles)

    def figures(
        self, batch: Any, samples: Mapping[str, Tensor], titles: Sequence[str]
    ) -> "dict[str, Figure]":
        """Draw what the task makes of a few clouds, by name; nothing by default.

        Args:
            batch: as for ``step``.
            samples: sampled points ``(B', M, 3)`` by readout.
            titles: one per cloud of the dataset.
        """
        return {}
