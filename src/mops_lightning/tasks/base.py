"""The contract that every task keeps."""

from collections.abc import Callable, Mapping, Sequence
from functools import singledispatch
from inspect import signature
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from torch import Generator, Tensor, nn
from torchmetrics import MetricCollection

from mops_lightning.errors import UserError
from mops_lightning.types import SampleOutput, TaskOutput

if TYPE_CHECKING:
    from matplotlib.figure import Figure

K = TypeVar("K")


class Task(nn.Module):
    """Base of all tasks: owns the task net, its losses and its metrics.

    A task implements ``step`` and ``metrics``, and, for distillation, ``predict`` and
    ``disagreement``. ``scores`` calls ``step`` by default.

    Args:
        net: the task net; its call signature is task-specific, see ``net_takes``.

    Raises:
        UserError: ``net`` is not a module, or takes other arguments than ``net_takes``.
    """

    score: str
    """Name of the metric that tables show by default; see ``metrics.info.MetricInfo``."""

    full_score: str | None = None
    """Name of the metric that scores the task net on full clouds; None: ``score``."""

    output_names: Literal["class_names", "part_names"] | None = None
    """Field of the data that names the net's outputs; None: a net fits data of other classes."""

    make_batch: Callable[[Tensor, list[Generator]], Any] | None = None
    """Converts clouds ``(B, N, 3)``, given one random generator per cloud, to the batch that
    ``step`` takes; None: ``step`` takes a ``Batch``."""

    net_takes: tuple[str, ...] = ("points",)
    """Names of the arguments of the net's ``forward``."""

    clouds_per_prediction: int = 1
    """Number of clouds that a prediction needs; ``points`` contains all first ones, and so on."""

    knows_residuals: bool = False
    """Whether ``sample_losses`` trains a sampler to predict residuals."""

    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        if not isinstance(net, nn.Module):
            raise UserError(f"net must be a torch.nn.Module, got {net!r}.")
        takes = tuple(signature(net.forward).parameters)
        if takes != self.net_takes:
            needed = ", ".join(self.net_takes)
            given = ", ".join(takes)
            raise UserError(
                f"net must take ({needed}), as "
                f"{type(self).__name__.lower()} needs it; got {type(net).__name__}, which takes "
                f"({given}). Choose a net of this task."
            )
        self.net = net

    def predict(self, batch: Any, points: Tensor) -> Any:
        """Return the net's output for sampled points, as ``disagreement`` compares it.

        Args:
            batch: a ``Batch``, or from ``make_batch``.
            points: as for ``step``.
        """
        raise NotImplementedError

    def disagreement(self, found: Any, reference: Any) -> Tensor:
        """Return how far predictions are from the reference, one value ``(B,)`` per cloud.

        Args:
            found: from ``predict``; gradients flow to it.
            reference: from ``predict``, for instance on all points.
        """
        raise NotImplementedError

    def step(self, batch: Any, points: Tensor) -> TaskOutput:
        """Run the net on sampled points, for training.

        Args:
            batch: as for ``predict``.
            points: ``(B', M, 3)`` sampled from ``batch.points``, in the same order.

        Returns:
            Loss terms, predictions and targets.
        """
        raise NotImplementedError

    def sample_losses(self, batch: Any, seen: Tensor, output: SampleOutput) -> dict[str, Tensor]:
        """Return losses of what a sampler tells beside its points; none by default.

        Args:
            batch: as for ``predict``.
            seen: ``(B', K, 3)`` the points of ``batch.points`` that the sampler has seen.
            output: the sampler's, for these points.
        """
        return {}

    def scores(self, batch: Any, samples: Mapping[K, Tensor]) -> dict[K, TaskOutput]:
        """Run the net on several samples of one batch, for scores; by default ``step`` on each.

        Args:
            batch: as for ``predict``.
            samples: points by name, each as for ``step``.

        Returns:
            Loss terms, predictions and targets by name.
        """
        return {name: self.step(batch, points) for name, points in samples.items()}

    def metrics(self, training: bool = False) -> MetricCollection:
        """Return new metrics of the predictions and targets of ``scores``.

        Args:
            training: return the metrics of ``step`` instead.
        """
        raise NotImplementedError


@singledispatch
def figures_of(
    task: Task,
    batch: Any,
    samples: Mapping[str, Tensor],
    titles: Sequence[str],
) -> "dict[str, Figure]":
    """Draw a task's results for a few clouds, by name; nothing unless a task registers a function.

    Args:
        task: in evaluation mode.
        batch: as for ``Task.step``.
        samples: sampled points by readout, each as for ``Task.step``.
        titles: one per cloud of the dataset.
    """
    return {}
