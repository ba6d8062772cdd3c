"""The metrics by which validation and test score readouts and sampled sets."""

from collections.abc import Callable, Iterable, Mapping
from itertools import product

from torch import Tensor, nn
from torchmetrics import MeanMetric, Metric, MetricCollection

from mops_lightning.metrics.sampled_set import SET_METRICS
from mops_lightning.types import SampleOutput, TaskOutput


class Scores(nn.Module):
    """Metrics of the task for each readout at each size, and metrics of the sampled sets.

    Every update returns the metrics that it changed, under the names they are logged by, without
    the stage: ``m32/generated/accuracy``, or ``generated/accuracy`` where one size is tested.

    Args:
        make_metrics: makes a collection of the task's metrics.
        readouts: names of the readouts.
        prefixes: prefixes of the sizes, such as ``m32/``; the empty one is added.
    """

    def __init__(
        self,
        make_metrics: Callable[[], MetricCollection],
        readouts: Iterable[str],
        prefixes: Iterable[str],
    ) -> None:
        super().__init__()
        prefixes = list(dict.fromkeys(["", *prefixes]))
        self.readouts = nn.ModuleDict()
        for name, prefix in product(readouts, prefixes):
            self.readouts[f"{prefix}{name}"] = make_metrics()
        self.sets = nn.ModuleDict()
        for (name, cls), prefix in product(SET_METRICS.items(), prefixes):
            self.sets[f"{prefix}{name}"] = cls()
        self.losses = nn.ModuleDict()  # the task's first result brings their names

    def update_readout(self, key: str, result: TaskOutput) -> dict[str, Metric]:
        """Update the task's metrics of one readout; ``key`` is its name behind its prefix."""
        collection = self.readouts[key]
        assert isinstance(collection, MetricCollection)
        collection.update(result.predictions, result.targets)
        metrics = collection.items(keep_base=True, copy_state=False)
        return {f"{key}/{name}": metric for name, metric in metrics}

    def update_loss(self, key: str, value: Tensor, clouds: int) -> Metric:
        """Update the mean of a loss over clouds, which processes may share unevenly."""
        if key not in self.losses:
            self.losses[key] = MeanMetric(nan_strategy="disable").to(value.device)
        mean = self.losses[key]
        assert isinstance(mean, MeanMetric)
        # MeanMetric ignores weights when it does not look for NaN, so each cloud counts itself.
        mean.update(value.expand(clouds))
        return mean

    def update_sets(
        self,
        points: Tensor,
        outputs: Mapping[int, SampleOutput],
        nested: bool,
        prefixes: Mapping[int, str],
    ) -> dict[str, Metric]:
        """Update the metrics of the sampled sets at every size.

        Args:
            points: ``(B, N, 3)`` the clouds.
            outputs: the sampler's, by size.
            nested: whether smaller sets are the first points of larger ones.
            prefixes: prefix of the log keys, by size.
        """
        # The largest nested set contains all smaller ones, so it is measured once for all.
        groups: dict[int, tuple[int, ...]] = {m: (m,) for m in outputs}
        if nested:
            groups = {max(outputs): tuple(outputs)}
        updated: dict[str, Metric] = {}
        for largest, sizes in groups.items():
            output = outputs[largest]
            for name, cls in SET_METRICS.items():
                measured = cls.measure(points, output, sizes) or {}
                for m, values in measured.items():
                    key = f"{prefixes[m]}{name}"
                    mean = self.sets[key]
                    assert isinstance(mean, cls)
                    mean.update(values)
                    updated[key] = mean
        return updated
