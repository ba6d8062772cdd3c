"""Keeping the best method of every number of points as a sampler.

Methods are chosen on one half of the files. A method other than farthest points is kept if it is
better than these on the other half, too.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from torch import nn

from mops_lightning.channels import NO_CHANNELS, PointChannels
from mops_lightning.errors import UserError
from mops_lightning.files.task_net.clouds import CHECKING, CHOOSING
from mops_lightning.files.task_net.measure import EVERYTHING
from mops_lightning.files.task_net.methods import Method, Trained, Untrained
from mops_lightning.metrics.info import MetricInfo
from mops_lightning.records.verdict import FPS, Gain, advise, better_fps
from mops_lightning.samplers.by_budget import ByBudget
from mops_lightning.zoo import model_file, weights

Values = Mapping[str, Sequence[float]]


@dataclass(frozen=True)
class Choice:
    """What is kept for one number of points.

    Attributes:
        m: number of points.
        method: its name.
        rejected: the method that was better on the first half only; empty: none.
        checked: of the chosen or rejected method over farthest points on the second half; None for
            farthest points.
    """

    m: int
    method: str
    rejected: str = ""
    checked: Gain | None = None

    @property
    def line(self) -> str:
        """What is kept, and why."""
        text = f"{self.m:,} points: {self.method}"
        if self.checked is None:
            return text
        word = "worse"
        if self.checked.mean > 0:
            word = "better"
        difference = f"{self.checked} {word}"
        if self.rejected:
            return f"{text}; {self.rejected} was {difference} on the other half"
        return f"{text}, {difference} than FPS on the other half"


def by_size(frame: pd.DataFrame, files: str) -> dict[int, dict[str, list[float]]]:
    """Return the scores of every draw by number of points, by method.

    Args:
        frame: columns of ``Score``.
        files: the group of files.
    """
    scores: dict[int, dict[str, list[float]]] = defaultdict(dict)
    is_chosen = (frame.files == files) & (frame.method != EVERYTHING)
    chosen = frame[is_chosen].sort_values("draw", kind="stable")
    for (m, method), group in chosen.groupby(["m", "method"], sort=False):
        scores[int(m)][str(method)] = group.score.tolist()
    return dict(sorted(scores.items()))


def by_part(frame: pd.DataFrame) -> dict[int, dict[str, list[float]]]:
    """Return the scores of every draw and half of the files; see ``by_size``."""
    first = by_size(frame, CHOOSING)
    second = by_size(frame, CHECKING)
    parts = {}
    for m, values in first.items():
        others = second.get(m, {})
        parts[m] = {name: draws + others.get(name, []) for name, draws in values.items()}
    return parts


def choose(frame: pd.DataFrame, metric: MetricInfo, methods: Sequence[Method]) -> list[Choice]:
    """Choose a method for every number of points.

    Args:
        frame: columns of ``Score``.
        metric: of the scores.
        methods: that were compared. Critical points are not chosen, because they need the net, nor
            are samplers in memory.
    """
    names = [method.name for method in methods if _is_savable(method)]
    first = by_size(frame, CHOOSING)
    second = by_size(frame, CHECKING)
    choices = []
    for m, values in first.items():
        choosable = {name: values[name] for name in names if name in values}
        choices.append(_choice(m, choosable, second[m], metric))
    return choices


def _is_savable(method: Method) -> bool:
    if isinstance(method, Trained):
        return method.path is not None
    return isinstance(method, Untrained)


def _choice(m: int, first: Values, second: Values, metric: MetricInfo) -> Choice:
    """Choose by the first half of the files, and check on the second."""
    advice = advise(m, first, metric)
    if advice.method in FPS:
        return Choice(m, advice.method)
    rival = better_fps(second, metric)
    values = second[advice.method]
    checked = Gain.of(values, second[rival], metric)
    if checked.mean > 0:
        return Choice(m, advice.method, checked=checked)
    return Choice(m, better_fps(first, metric), advice.method, checked)


def save(path: Path, choices: Sequence[Choice], methods: Sequence[Method], seed: int) -> None:
    """Write the chosen methods as one sampler.

    Args:
        path: the file.
        choices: from ``choose``.
        methods: that were compared.
        seed: of random choices.

    Raises:
        UserError: two trained samplers see other channels.
    """
    by_name = {method.name: method for method in methods}
    # The first one fills in for sizes that were not compared.
    fallback = _fallback(choices)
    chosen = [choice.method for choice in choices]
    used = list(dict.fromkeys([fallback, *chosen]))
    nodes: list[dict[str, Any]] = []
    samplers: list[nn.Module] = []
    channels = NO_CHANNELS
    for name in used:
        method = by_name[name]
        if isinstance(method, Trained):
            channels = _common(channels, method.sampler.point_channels)
            nodes.append(method.node())
            samplers.append(method.sampler)
        else:
            assert isinstance(method, Untrained)
            nodes.append(method.node(seed))
            samplers.append(method.sampler(1, seed))
    budgets = [choice.m for choice in choices]
    best = [used.index(name) for name in chosen]
    module = ByBudget(budgets, best, samplers, channels)  # type: ignore[arg-type]
    node = {
        "_target_": f"{ByBudget.__module__}.{ByBudget.__qualname__}",
        "budgets": budgets,
        "best": best,
        "samplers": nodes,
    }
    config = {
        "learn": "sampler",
        "sampler": node,
        "chosen": [choice.line for choice in choices],
    }
    weights.save(path, module, config, {}, channels=channels)


def _fallback(choices: Sequence[Choice]) -> str:
    """Return the form of farthest points for sizes that were not compared."""
    forms = [choice.method for choice in choices if choice.method in FPS]
    return max(FPS, key=forms.count)


def _common(channels: PointChannels, others: PointChannels) -> PointChannels:
    """Return the channels of two samplers, of which one may have none.

    Raises:
        UserError: they differ.
    """
    if channels and others and channels != others:
        raise UserError(
            "--save: two of the best samplers were trained with other statistics of the channels. "
            "Give one of them with --weights."
        )
    return others or channels


def file_of(name: str) -> Path:
    """Return the file of a saved sampler.

    Args:
        name: as the user gave it, with or without the suffix.
    """
    path = Path(name).expanduser()
    if path.suffix == model_file.SUFFIX:
        return path
    return path.with_name(f"{path.name}{model_file.SUFFIX}")
