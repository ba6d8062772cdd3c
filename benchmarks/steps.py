"""Time and memory of the steps of modules that differ in their settings."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from cases import Row, cloud, seconds
from measure import interleaved, peak_memory
from torch import Tensor, nn

CLOUDS = 32


def by_step(
    build: Callable[..., nn.Module],
    kinds: Sequence[dict[str, Any]],
    steps: Sequence[Callable[[Any, Tensor], object]],
    rounds: int,
) -> list[Row]:
    """Return time and memory per cloud of 1,024 points, in batches of 32.

    Args:
        build: makes a module; a function of a module of this folder, as the steps are.
        kinds: its arguments, which name the rows.
        steps: functions of a module and points.
        rounds: number of measurements.
    """
    points = cloud(1024, CLOUDS)
    rows: list[Row] = []
    for step in steps:
        calls = {f"{kind}": partial(step, build(**kind), points) for kind in kinds}
        for kind, timing in zip(kinds, interleaved(calls, rounds).values(), strict=True):
            setup = (
                f"from cases import cloud\nfrom {build.__module__} import *\n"
                f"module, points = build(**{kind}), cloud(1024, {CLOUDS})"
            )
            memory, _ = peak_memory(setup, f"{step.__name__}(module, points)")
            row = {name: str(value).strip("[]") for name, value in kind.items()}
            row["step"] = step.__name__
            rows.append({**row, **seconds(timing, CLOUDS), "peak_bytes": memory / CLOUDS})
    return rows
