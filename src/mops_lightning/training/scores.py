"""The readouts of a sampler, and the metrics by which validation and test score them."""

from collections.abc import Callable, Iterable, Mapping

from torch import Tensor, nn
from torchmetrics import MeanMetric, Metric, MetricCollection

from mops_lightning.metrics.sampled_set import SET_METRICS
from mops_lightning.ops.points import gather_points
from mops_lightning.ops.readout import complete, match
from mops_lightning.records.readout_names import FULL, GENERATED_READOUTS, INDEX_READOUT
from mops_lightning.samplers.base import Sampler
from mops_lightning.types import SampleOutput, TaskOutput


def names_of_readouts(sampler: Sampler | None) -> tuple[str, ...]:
    """Return the names of a sampler's readouts; without a sampler only the full cloud is scored."""
    if sampler is None:
        return (FULL,)
    return GENERATED_READOUTS if sampler.generates else (INDEX_READOUT,)


def readouts(
    points: Tensor, outputs: Mapping[int, SampleOutput], sampler: Sampler | None
) -> dict[int, dict[str, Tensor]]:
    """Return every readout at every size.

    Args:
        points: ``(B, N, 3)`` the clouds.
        outputs: what ``sampler.sample_sizes`` returned for them, by size.
        sampler: says whether it generates points and whether its sizes are nested; None for
            outputs that are the clouds themselves.

    Returns:
        By size m, then by readout, the points ``(B, m, 3)``: ``generated``, ``matched`` and
        ``completed`` of a sampler that generates points, ``sampled`` of one that selects them,
        ``full`` without a sampler.
    """
    samples: dict[int, dict[str, Tensor]] = {}
    names = names_of_readouts(sampler)
    generates = sampler is not None and sampler.generates
    # Points are matched one by one, so matching the largest nested set matches all smaller ones.
    nested = generates and sampler is not None and sampler.nested
    largest = match(outputs[max(outputs)].points, points) if nested else None
    for m, output in outputs.items():
        sets = [output.points]
        if generates:
            matched = match(output.points, points) if largest is None else largest[:, :m]
            completed = complete(matched, points)
            sets += [gather_points(points, matched), gather_points(points, completed)]
        samples[m] = dict(zip(names, sets, strict=True))
    return samples


class Scores(nn.Module):
    """Metrics of the task for each readout at each size, and metrics of the sampled sets.

    Every update returns the metrics that it changed, under the names they are logged by, without
    the stage: ``m32/generated/accuracy``, or ``generated/accuracy`` where one size is tested.

    Args:
        make_metrics: makes a collection of the task's metrics.
        readouts: names of the readouts.
        prefixes: of the sizes, such as ``m32/``; the empty one is always there.
    """

    def __init__(
        self,
        make_metrics: Callable[[], MetricCollection],
        readouts: Iterable[str],
        prefixes: Iterable[str],
    ) -> None:
        super().__init__()
        prefixes = dict.fromkeys(("", *prefixes))
        self.readouts = nn.ModuleDict(
            {f"{prefix}{name}": make_metrics() for name in readouts for prefix in prefixes}
        )
        self.sets = nn.ModuleDict(
            {f"{prefix}{name}": cls() for name, cls in SET_METRICS.items() for prefix in prefixes}
        )
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
            prefixes: by size.
        """
        # The largest nested set contains all smaller ones, so it is measured once for all.
        groups = {max(outputs): tuple(outputs)} if nested else {m: (m,) for m in outputs}
        updated: dict[str, Metric] = {}
        for largest, sizes in groups.items():
            output = outputs[largest]
            for name, cls in SET_METRICS.items():
                for m, values in (cls.measure(points, output, sizes) or {}).items():
                    key = f"{prefixes[m]}{name}"
                    mean = self.sets[key]
                    assert isinstance(mean, cls)
                    mean.update(values)
                    updated[key] = mean
        return updated
