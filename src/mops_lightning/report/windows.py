"""Compare how much samplers vary where their settings change by equal ratios."""

from collections.abc import Iterator, Sequence
from itertools import permutations, product

from mops_lightning.report.cells import Cells, Column, sort_key
from mops_lightning.report.text import Grid

ROUNDING = 1 + 1e-6
"""Tolerance of ratios: 1e-3 / 1e-5 is slightly above 100."""

Window = tuple[tuple[float, ...], ...]
"""Neighbouring values of both settings of a heat map."""


def equal_ratios(table: Cells, planes: dict[str, tuple[str, str]]) -> Grid | None:
    """Return the spread of every sampler over windows of equal ratios, and who varies less.

    Heat maps of two samplers may cover unequal ranges, and the larger range shows the larger
    spread. In a window, each setting changes by at most the ratio that all heat maps cover in one
    of their settings.

    Args:
        table: the values of one metric.
        planes: sampler → the two settings of its heat map.

    Returns:
        One row per window without a missing run, one column per readout: the largest over the
        smallest value. None if there is one sampler only, or a setting or a value is not positive.
    """
    names = sorted(planes, key=sort_key)
    found = {name: table.plane(name) for name in names}
    readouts = list(found[names[0]])
    axes = {
        name: tuple(sorted(set(values)) for values in zip(*found[name][readouts[0]], strict=True))
        for name in names
    }
    figures = [one for by in found.values() for plane in by.values() for one in plane.values()]
    settings = [one for both in axes.values() for axis in both for one in axis]
    same = all(list(by) == readouts for by in found.values())
    if len(names) < 2 or not same or min(*figures, *settings) <= 0:
        return None
    ratio = min(max(axis[-1] / axis[0] for axis in both) for both in axes.values())
    spreads = {
        name: {
            window: {readout: _spread(plane, window) for readout, plane in found[name].items()}
            for window in product(*(_runs(axis, ratio) for axis in axes[name]))
            if all(place in plane for plane in found[name].values() for place in product(*window))
        }
        for name in names
    }
    rows = [
        [f"{name}, {_text(planes[name], window)}", *(f"{values[one]:.3g}" for one in readouts)]
        for name in names
        for window, values in spreads[name].items()
    ]
    title = (
        f"Test {table.metric.title}: largest over smallest value in each window in which no "
        f"setting changes by more than a factor of {ratio:.3g}."
    )
    below = []
    for one, other in permutations(names, 2):
        counts = []
        for readout in readouts:
            pairs = list(product(spreads[one].values(), spreads[other].values()))
            less = sum(mine[readout] < theirs[readout] for mine, theirs in pairs)
            counts.append(f"{readout} {less} of {len(pairs)}")
        below.append(f"{one} varies less than {other} in pairs of windows: {', '.join(counts)}.")
    return Grid(title, ["window", *readouts], rows, below)


def _runs(values: Sequence[float], ratio: float) -> Iterator[tuple[float, ...]]:
    """Yield the longest runs of ascending values that span at most a factor of ``ratio``."""
    last = 0
    for start, low in enumerate(values):
        end = sum(value <= low * ratio * ROUNDING for value in values)
        if end > last:  # otherwise the previous run contains this one
            yield tuple(values[start:end])
        last = end


def _spread(plane: dict[Column, float], window: Window) -> float:
    values = [plane[place] for place in product(*window)]
    return max(values) / min(values)


def _text(keys: tuple[str, str], window: Window) -> str:
    parts = zip((key.split(".")[-1] for key in keys), window, strict=True)
    return ", ".join(
        f"{name} {values[0]:g}" + (f" to {values[-1]:g}" if len(values) > 1 else "")
        for name, values in parts
    )
