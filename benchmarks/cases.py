"""The benchmarks: each function returns table rows as plain dictionaries."""

from collections.abc import Callable
from functools import partial
from typing import Any

import libraries
import torch
from libraries import Calls
from measure import Timing, flops, interleaved, peak_memory
from torch import Tensor, nn
from twins import PlainMOPS, plain_farthest_point_sample

from mops_lightning.nets.foldingnet import MFoldingNet
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.ops.attention import attend
from mops_lightning.ops.flat_fps import fps
from mops_lightning.ops.fps import farthest_point_sample
from mops_lightning.ops.nearest import (
    k_nearest,
    nearest,
    nearest_features,
    search_by_product,
    search_in_blocks,
)
from mops_lightning.ops.readout import complete, match
from mops_lightning.samplers.base import stream_sample
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.samplers.poisson import eliminate
from mops_lightning.samplers.random import RandomSampler
from mops_lightning.samplers.samplenet import SampleNet
from mops_lightning.samplers.snet import SNet
from mops_lightning.samplers.voxel import VoxelSampler
from mops_lightning.training.run.memory import keep_freed_memory

Row = dict[str, Any]
SIZES = (512, 256, 128, 64, 32, 16, 8)
LARGE = (4096, 1024, 256)
CHUNK = 8192


def cloud(number: int, clouds: int = 1) -> Tensor:
    """Return points on the unit sphere, the same at every call: surfaces, as real clouds are."""
    rng = torch.Generator().manual_seed(number)
    return nn.functional.normalize(torch.randn(clouds, number, 3, generator=rng), dim=2)


def frozen(net: nn.Module, points: Tensor) -> Tensor:
    """Return the points of a sampler, or of a plain twin, in eval mode."""
    with torch.no_grad():
        made = net.eval().requires_grad_(False)(points)
    return made if isinstance(made, Tensor) else made.points


def chunked(sampler: MOPSNet, points: Tensor, size: int = CHUNK) -> Tensor:
    """Return the sampled points, computed from chunks of the cloud."""
    return stream_sample(sampler, partial(points[0].split, size))


def inference(peak: dict[str, float], rounds: int) -> list[Row]:
    """Seconds per cloud of 1,024 points, 32 in a batch, all samplers (the paper's run times)."""
    points = cloud(1024, 32)
    rows: list[Row] = []
    for m in SIZES:
        mops = MOPSNet(m)
        samplers: dict[str, nn.Module] = {
            "random": RandomSampler(m),
            "voxel": VoxelSampler(m),
            "fps": FPSSampler(m),
            "snet": SNet(m),
            "samplenet": SampleNet(m),
            "mops": mops,
            "mops, plain twin": PlainMOPS(mops),
        }
        _equal(frozen(mops, points), frozen(samplers["mops, plain twin"], points))
        calls: Calls = {name: partial(frozen, net, points) for name, net in samplers.items()}
        names = {"N": 1024, "m": m}
        rows += _rows("sampler", calls, names, rounds, peak, clouds=32)
    return rows


def large(peak: dict[str, float], rounds: int) -> list[Row]:
    """One cloud of 40,960 points (the paper's table of run time and memory)."""
    points = cloud(40960)
    rows: list[Row] = []
    for m in LARGE:
        sampler = MOPSNet(m)
        plain = PlainMOPS(sampler)
        _equal(frozen(sampler, points), frozen(plain, points))
        calls: Calls = {
            "mops": partial(frozen, sampler, points),
            "mops, in chunks": partial(chunked, sampler, points),
            "mops, plain twin": partial(frozen, plain, points),
            "fps": partial(farthest_point_sample, points, m),
        }
        bodies = {
            "mops": "frozen(s, points)",
            "mops, in chunks": "chunked(s, points)",
            "mops, plain twin": "frozen(PlainMOPS(s), points)",
            "fps": f"farthest_point_sample(points, {m})",
        }
        for row in _rows("sampler", calls, {"N": 40960, "m": m}, rounds, peak):
            memory, _ = peak_memory(_SETUP.format(number=40960, m=m), bodies[row["sampler"]])
            rows.append({**row, "peak_bytes": memory})
    return rows


_SETUP = """
from cases import *
points, s = cloud({number}), MOPSNet({m})
torch.randn(512, 512) @ torch.randn(512, 512)
"""


def modules(peak: dict[str, float], rounds: int) -> list[Row]:
    """Time and memory by module for a cloud of 40,960 points (the paper's table of modules)."""
    points = cloud(40960)[0]
    rows: list[Row] = []
    for m in LARGE:
        found = Parts(points, m)
        calls: Calls = {name: getattr(found, name) for name in PARTS}
        timed = _rows("module", calls, {"N": 40960, "m": m}, rounds, peak)
        for row in timed:
            setup = _SETUP.format(number=40960, m=m) + "parts = Parts(points[0], s.m)\n"
            memory, _ = peak_memory(setup, f"parts.{row['module']}()")
            rows.append({**row, "peak_bytes": memory})
    return rows


PARTS = ("features", "matrix", "regression", "pointnet", "mfoldingnet")


class Parts:
    """MOPS-Net's modules and two task nets, each with its input prepared.

    Args:
        points: ``(N, 3)``.
        m: number of generated points.
    """

    def __init__(self, points: Tensor, m: int) -> None:
        self.points = points
        self.net = MOPSNet(m).eval().fused()
        self.local = self.net.local_features(points)
        self.peak = self.local.amax(0)
        self.keys = self.net.keys(self.local, self.peak)
        self.generated = attend(self.net.queries, self.keys, points).result()[None]
        self.classifier = PointNetVanilla(40).eval().requires_grad_(False)
        self.builder = MFoldingNet(len(points), 128, 2048).eval().requires_grad_(False)

    def features(self) -> Tensor:
        """Extract local features."""
        return self.net.local_features(self.points)

    def matrix(self) -> Tensor:
        """Compute the keys of the sampling matrix."""
        return self.net.keys(self.local, self.peak)

    def regression(self) -> Tensor:
        """Compute the sampled points."""
        return attend(self.net.queries, self.keys, self.points).result()

    def pointnet(self) -> Tensor:
        """Classify the generated points."""
        return self.classifier(self.generated)

    def mfoldingnet(self) -> Tensor:
        """Reconstruct N points from the generated ones."""
        return self.builder(self.generated)


def training(peak: dict[str, float], rounds: int) -> list[Row]:
    """One cloud's share of a training step of the sampler alone, 32 clouds in a batch.

    Freed memory is kept for the next step, as in every training run.
    """
    keep_freed_memory()
    points = cloud(1024, 32)
    nets = {"mops": MOPSNet(32).train(), "mops, plain twin": PlainMOPS(MOPSNet(32)).train()}
    calls: Calls = {name: partial(step, net, points) for name, net in nets.items()}
    return _rows("training", calls, {"N": 1024, "m": 32}, rounds, peak, clouds=32)


def compiled(peak: dict[str, float], rounds: int) -> list[Row]:
    """The training step with torch.compile, which needs a C++ compiler and minutes to compile."""
    keep_freed_memory()
    points, net, made = cloud(1024, 32), MOPSNet(32).train(), MOPSNet(32).train()
    made.compile()
    calls: Calls = {
        "mops": partial(step, net, points),
        "mops, compiled": partial(step, made, points),
    }
    return _rows("training", calls, {"N": 1024, "m": 32}, rounds, peak, clouds=32)


def step(net: nn.Module, points: Tensor) -> None:
    """Run one forward and one backward pass."""
    net.zero_grad()
    made = net(points)
    (made if isinstance(made, Tensor) else made.points).square().sum().backward()


FARTHEST = [(1024, 32), (1024, 512), (10_000, 1024), (40_960, 4096), (100_000, 1024)]
FARTHEST += [(1_000_000, 1000)]


def farthest(peak: dict[str, float], rounds: int) -> list[Row]:
    """Farthest point sampling, and other libraries."""
    rows: list[Row] = []
    for number, m in FARTHEST:
        points = cloud(number)
        own = partial(farthest_point_sample, points, m)
        calls: Calls = {"fps": own}
        if number * m <= 2**25:
            calls["fps, plain twin"] = partial(plain_farthest_point_sample, points[0], m)
        others = libraries.farthest(points[0], m)
        wanted = {tuple(point) for point in points[0, own()[0]].tolist()}
        shared = {
            name: len(wanted & {tuple(point) for point in call().astype("f4").tolist()})
            for name, call in others.items()
        }
        setup = (
            f"from cases import *\npoints = cloud({number})\nfarthest_point_sample(cloud(64), 2)"
        )
        for row in _rows("sampler", calls | others, {"N": number, "m": m}, rounds, peak):
            row["points as ours"] = shared.get(row["sampler"], m)
            if row["sampler"] == "fps" and number >= 40_960:
                row["peak_bytes"] = peak_memory(setup, f"farthest_point_sample(points, {m})")[0]
            rows.append(row)
    return rows


def flat_farthest(peak: dict[str, float], rounds: int) -> list[Row]:
    """The replacement of torch_geometric.nn.fps, and fpsample."""
    rows: list[Row] = []
    for number, m in ((50_000, 4096), (100_000, 50_000), (1_000_000, 1000)):
        points = cloud(number)[0]
        own = partial(fps, points, ratio=(m - 0.5) / number, random_start=False)
        assert torch.equal(own(), farthest_point_sample(points[None], m)[0])
        others = libraries.farthest(points, m)
        buckets = {name: call for name, call in others.items() if "buckets" in name}
        calls: Calls = {"mops_lightning.fps": own, **buckets}
        rows += _rows("function", calls, {"N": number, "m": m}, rounds, peak)
    return rows


def completed(peak: dict[str, float], rounds: int) -> list[Row]:
    """Matched and completed sets of 40,960 points."""
    points = cloud(40960)
    generated = 0.97 * cloud(4096)
    matched = match(generated, points)
    calls: Calls = {
        "matched": partial(match, generated, points),
        "completed from matched": partial(complete, matched, points),
        "fps": partial(farthest_point_sample, points, 4096),
    }
    return _rows("readout", calls, {"N": 40960, "m": 4096}, rounds, peak)


def poisson(peak: dict[str, float], rounds: int) -> list[Row]:
    """Poisson-disk sampling by elimination."""
    rows: list[Row] = []
    for number, m in ((1024, 128), (10_000, 1000), (100_000, 1000), (100_000, 10_000)):
        calls: Calls = {"poisson": partial(eliminate, cloud(number), m)}
        rows += _rows("sampler", calls, {"N": number, "m": m}, rounds, peak)
    return rows


def neighbours(peak: dict[str, float], rounds: int) -> list[Row]:
    """Nearest points, and other libraries."""
    rows: list[Row] = []
    for number, m in ((1024, 1024), (10_000, 1024), (40_960, 4096), (40_960, 40_960)):
        points, queries = cloud(number), cloud(m + 1)[:, :m]
        calls: Calls = {"nearest": partial(nearest, queries, points)}
        others = libraries.nearest(queries[0], points[0])
        own = nearest(queries, points)[1][0].numpy()
        shared = {name: int((call() == own).sum()) for name, call in others.items()}
        for row in _rows("search", calls | others, {"N": number, "m": m}, rounds, peak):
            rows.append({**row, "points as ours": shared.get(row["search"], m)})
    return rows


def several(peak: dict[str, float], rounds: int) -> list[Row]:
    """The k nearest points, by compiled loops and in torch."""
    rows: list[Row] = []
    for number, m, k in ((1024, 256, 16), (1024, 1024, 32), (40_960, 4096, 16)):
        points, queries = cloud(number), cloud(m + 1)[:, :m]
        calls: Calls = {
            f"{k} nearest": partial(k_nearest, queries, points, k),
            f"{k} nearest, in torch": partial(search_in_blocks, queries, points, k),
        }
        rows += _rows("search", calls, {"N": number, "m": m}, rounds, peak)
    return rows


def features(peak: dict[str, float], rounds: int) -> list[Row]:
    """The 16 nearest points in the space of features, by compiled loops and a matrix product."""
    rows: list[Row] = []
    for number in (256, 1024):
        for channels in (3, 64, 128):
            known = torch.randn(8, number, channels, generator=torch.Generator().manual_seed(0))
            calls: Calls = {
                "16 nearest features": partial(nearest_features, known, 16),
                "by a matrix product": partial(search_by_product, known, 16),
            }
            names = {"N": number, "channels": channels}
            rows += _rows("search", calls, names, rounds, peak, clouds=8)
    return rows


def growth(peak: dict[str, float], rounds: int) -> list[Row]:
    """Time and memory for N up to 10,000,000 and m up to 65,536 in chunks of 65,536; one call."""
    sizes = [(100_000, m) for m in (256, 4096, 16384, 65536)]
    sizes += [(number, 4096) for number in (1_000_000, 10_000_000)]
    rows: list[Row] = []
    for number, m in sizes:
        setup = _SETUP.format(number=number, m=m)
        memory, seconds = peak_memory(setup, "chunked(s.eval(), points, 65536)")
        names = {"sampler": "mops, in chunks", "N": number, "m": m}
        rows.append({**names, "seconds": seconds, "rounds": 1, "peak_bytes": memory})
    return rows


def _equal(fast: Tensor, plain: Tensor) -> None:
    """Check that both results agree before they are timed."""
    torch.testing.assert_close(fast, plain, rtol=1e-3, atol=1e-4)


def _rows(
    kind: str,
    calls: Calls,
    names: Row,
    rounds: int,
    peak: dict[str, float],
    clouds: int = 1,
) -> list[Row]:
    """Time the calls in turn; return one row for each, per cloud."""
    rows = []
    for name, timing in interleaved(calls, rounds).items():
        row = {kind: name, **names, **seconds(timing, clouds)}
        operations = flops(calls[name])
        if operations:
            reached = operations / timing.median / peak["flops"]
            row |= {"flop": operations / clouds, "share_of_ceiling": reached}
        rows.append(row)
    return rows


def seconds(timing: Timing, clouds: int) -> Row:
    """Return the time per cloud as columns of a row."""
    spread = (timing.high - timing.low) / clouds
    return {"seconds": timing.median / clouds, "spread": spread, "rounds": timing.rounds}


ALL: dict[str, Callable[[dict[str, float], int], list[Row]]] = {
    "inference": inference,
    "large": large,
    "modules": modules,
    "farthest": farthest,
    "flat_farthest": flat_farthest,
    "completed": completed,
    "poisson": poisson,
    "neighbours": neighbours,
    "several": several,
    "features": features,
    "growth": growth,
    # Last, because they change the process's memory settings; also on the command line.
    "training": training,
    "compiled": compiled,
}
