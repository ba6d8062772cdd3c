"""Benchmark of local columns of S against full columns and farthest points."""

from functools import partial

from cases import Row, cloud, frozen, seconds, step
from libraries import Calls
from measure import interleaved

from mops_lightning.ops.fps import farthest_point_sample
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.samplers.mops import MOPSNet

KINDS = ((4, 32), (4, 16), (2, 16))
"""Candidates per point and entries of a column."""


def nets(m: int) -> dict[str, MOPSNet]:
    """Return samplers with local columns."""
    return {
        f"local columns, c={c}, k={k}": MOPSNet(m, anchors="fps", candidates=c, neighbours=k)
        for c, k in KINDS
    }


def local(_peak: dict[str, float], rounds: int) -> list[Row]:
    """Local columns, full columns and farthest points; seconds per cloud, untrained nets.

    Clouds are spheres. ``sample`` in evaluation, one cloud; ``learn`` is a training step of the
    sampler alone with 8 clouds. Full columns of 1,000,000 points take too long to be repeated.
    """
    rows: list[Row] = []
    for number, m in ((1_000_000, 4096), (40_960, 4096)):
        points = cloud(number)
        calls: Calls = {
            "farthest points": partial(farthest_point_sample, points, m),
            "FPSSampler": partial(frozen, FPSSampler(m), points),
        }
        if number < 1_000_000:
            calls["full columns"] = partial(frozen, MOPSNet(m, anchors="fps"), points)
        calls |= {name: partial(frozen, net, points) for name, net in nets(m).items()}
        rows += _timed(calls, {"N": number, "m": m, "step": "sample"}, rounds, 1)
    points = cloud(10_000, 8)
    calls = {"full columns": partial(step, MOPSNet(256, anchors="fps"), points)}
    calls |= {name: partial(step, net, points) for name, net in nets(256).items()}
    return rows + _timed(calls, {"N": 10_000, "m": 256, "step": "learn"}, rounds, 8)


def _timed(calls: Calls, names: Row, rounds: int, clouds: int) -> list[Row]:
    timings = interleaved(calls, rounds).items()
    return [{"sampler": name, **names, **seconds(timing, clouds)} for name, timing in timings]
