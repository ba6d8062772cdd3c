"""The sentence that ends a comparison: which method to use for how many points."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import sqrt
from statistics import fmean, stdev

from mops_lightning.metrics.info import MetricInfo

FPS = {
    "fps": "FPS",
    "fps_farthest": "FPS from the farthest point",
}
"""The two forms of farthest point sampling, and what a sentence calls them."""

LEVEL = 0.01
"""Relative difference that counts as the spread of a single draw; of percentages, one point."""

WORDS = (
    "no",
    "one",
    "two",
    "three",
    "four",
    "five",
    "six",
    "seven",
    "eight",
    "nine",
    "ten",
)

Draws = Sequence[float]
"""The values of one method, one for each draw; all methods see the same draws."""


Scores = Mapping[int, Mapping[str, Draws]]
"""The values of all methods by number of points."""


@dataclass(frozen=True)
class Gain:
    """How much better than a rival a method is, draw by draw.

    Attributes:
        mean: over the draws; above 0 is better. Percentages: in percentage points. Other values:
            relative to the rival's, or a plain difference where the rival's are not all above 0.
        spread: twice the standard error of the mean.
        unit: text behind the number, empty for a plain difference.
    """

    mean: float
    spread: float
    unit: str

    @classmethod
    def of(
        cls,
        values: Draws,
        rival: Draws,
        metric: MetricInfo,
        draws: int | None = None,
    ) -> "Gain":
        """Compare two methods.

        Args:
            values: of the method.
            rival: of the rival, from the same draws.
            metric: says which direction is better.
            draws: number of draws, if each gave several values, which may depend on each other.
        """
        sign = -1.0
        if metric.higher_is_better:
            sign = 1.0
        pairs = zip(values, rival, strict=True)
        differences = [sign * (value - other) for value, other in pairs]
        level = 100 * LEVEL
        if metric.unit == "%":
            unit = "percentage points"
            differences = [metric.scale * difference for difference in differences]
        elif min(rival) > 0:
            unit = "%"
            shares = zip(differences, rival, strict=True)
            differences = [100 * difference / other for difference, other in shares]
        else:
            unit = ""
            level = LEVEL
        spread = level
        if len(differences) > 1:
            number = draws or len(differences)
            spread = 2 * stdev(differences) / sqrt(number)
        return cls(fmean(differences), spread, unit)

    @property
    def is_sure(self) -> bool:
        """Whether the method is better beyond the spread."""
        return self.mean > self.spread

    def __str__(self) -> str:
        """Return the absolute value with its unit."""
        size = abs(self.mean)
        number = f"{size:.0f}"
        if size < 10:
            number = f"{size:.2g}"
        return f"{number} {self.unit}".rstrip()


@dataclass(frozen=True)
class Advice:
    """What to use for one number of points.

    Attributes:
        m: number of points.
        method: the best method, if it is better than farthest points beyond the spread; otherwise
            the better form of farthest points.
        gains: of every other method over these farthest points.
    """

    m: int
    method: str
    gains: dict[str, Gain]


def better_fps(values: Mapping[str, Draws], metric: MetricInfo) -> str:
    """Return the form of farthest point sampling with the better mean."""
    forms = [name for name in FPS if name in values]
    sign = 1.0
    if metric.higher_is_better:
        sign = -1.0
    return min(forms, key=lambda name: sign * fmean(values[name]))


def advise(
    m: int,
    values: Mapping[str, Draws],
    metric: MetricInfo,
    parts: Mapping[str, Draws] | None = None,
) -> Advice:
    """Return what to use for m points.

    Args:
        m: number of points.
        values: of all methods, a form of farthest point sampling among them.
        metric: of the values.
        parts: values of parts of the data in every draw, from which the spread is taken; None:
            between the draws.
    """
    fps = better_fps(values, metric)
    gains = {}
    for name, draws in values.items():
        if name in FPS:
            continue
        gain = Gain.of(draws, values[fps], metric)
        if parts is not None:
            of_parts = Gain.of(parts[name], parts[fps], metric, len(draws))
            gain = replace(gain, spread=of_parts.spread)
        gains[name] = gain
    sure = {name: gain for name, gain in gains.items() if gain.is_sure}
    best = max(sure, key=lambda name: sure[name].mean, default=fps)
    return Advice(m, best, gains)


def verdict(
    scores: Scores,
    metric: MetricInfo,
    own: Sequence[str] = (),
    parts: Scores | None = None,
) -> str:
    """Return the sentence.

    Args:
        scores: values by number of points, by method. Sizes without farthest points are left out.
        metric: of the values.
        own: the user's trained samplers, by their names among the methods.
        parts: see ``advise``.

    Returns:
        Such as ``Use FPS from 64 points on; your sampler is 9 % better at 16 (five draws).``; empty
        where nothing is compared with farthest points.
    """
    advice = []
    draws = 0
    for m in sorted(scores):
        values = scores[m]
        has_fps = any(name in values for name in FPS)
        has_others = bool(set(values) - set(FPS))
        if has_fps and has_others:
            parts_of_size = None
            if parts is not None:
                parts_of_size = parts[m]
            advice.append(advise(m, values, metric, parts_of_size))
            draws = len(next(iter(values.values())))
    if not advice:
        return ""
    called = _names_of_methods(advice, own)
    clauses = [_lead(advice, called), *_wins(advice, called, own)]
    clauses += _losses(advice, called, own)
    return f"{'; '.join(clauses)} ({_number_of_draws(draws)})."


def _names_of_methods(advice: Sequence[Advice], own: Sequence[str]) -> dict[str, str]:
    """Return what the sentence calls each method."""
    called = {}
    for of_size in advice:
        for name in of_size.gains:
            called[name] = name
    called |= FPS
    if len(own) == 1:
        called[own[0]] = "your sampler"
    return called


def _number_of_draws(draws: int) -> str:
    number = str(draws)
    if draws < len(WORDS):
        number = WORDS[draws]
    if draws == 1:
        return f"{number} draw"
    return f"{number} draws"


def _lead(advice: Sequence[Advice], called: Mapping[str, str]) -> str:
    """Return what to use for the largest number of points, and from which number on."""
    last = advice[-1].method
    is_fps = last in FPS
    start = len(advice) - 1
    while start and _is_same(advice[start - 1].method, last):
        start -= 1
    forms = {of_size.method for of_size in advice[start:]}
    name = called[last]
    if is_fps and len(forms) > 1:
        name = "FPS"
    if start:
        return f"Use {name} from {advice[start].m:,} points on"
    smallest = advice[0].m
    if len(advice) == 1:
        return f"Use {name} for {smallest:,} points"
    largest = advice[-1].m
    return f"Use {name} for {smallest:,} to {largest:,} points"


def _is_same(method: str, other: str) -> bool:
    return method == other or (method in FPS and other in FPS)


def _wins(advice: Sequence[Advice], called: Mapping[str, str], own: Sequence[str]) -> list[str]:
    """Return a clause for every method that is best somewhere."""
    clauses = []
    methods = [of_size.method for of_size in advice]
    winners = dict.fromkeys(method for method in methods if method not in FPS)
    # A user's own sampler first.
    for name in sorted(winners, key=lambda name: name not in own):
        wins = [of_size for of_size in advice if of_size.method == name]
        parts = [_win(of_size, own, called) for of_size in wins]
        parts[0] = parts[0].replace(" at ", " better at ", 1)
        clauses.append(f"{called[name]} is {_joined(parts)}")
    if clauses and advice[-1].method not in FPS:
        clauses[0] = clauses[0].replace(" better at ", " better than FPS at ", 1)
    return clauses


def _win(of_size: Advice, own: Sequence[str], called: Mapping[str, str]) -> str:
    gains = of_size.gains
    text = f"{gains[of_size.method]} at {of_size.m:,}"
    seconds = [name for name in own if name in gains and gains[name].is_sure]
    if of_size.method not in own and seconds:
        best = max(seconds, key=lambda name: gains[name].mean)
        text += f" ({called[best]}: {gains[best]})"
    return text


def _losses(advice: Sequence[Advice], called: Mapping[str, str], own: Sequence[str]) -> list[str]:
    """Return a clause about the user's best sampler if it is nowhere better than FPS."""
    gains = []
    for of_size in advice:
        for name in own:
            if name in of_size.gains:
                gains.append((of_size.gains[name], of_size.m, name))
    if not gains or any(gain.is_sure for gain, _, _ in gains):
        return []
    gain, m, name = max(gains, key=lambda entry: entry[0].mean)
    if gain.mean > 0:
        return [f"{called[name]} is nowhere better beyond the spread, at best {gain} at {m:,}"]
    if gain.mean == 0:
        return [f"{called[name]} is nowhere better, at best level at {m:,}"]
    return [f"{called[name]} is nowhere better, at best {gain} worse at {m:,}"]


def _joined(parts: Sequence[str]) -> str:
    """Return parts as ``a, b and c``."""
    if len(parts) == 1:
        return parts[0]
    *others, last = parts
    return f"{', '.join(others)} and {last}"
