"""``python benchmarks/gpu.py``: time and memory on a GPU, written as a record and a table."""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from cases import cloud, frozen, step
from measure import ceiling, machine
from torch import Tensor
from torch.nn import functional as F
from torch.profiler import ProfilerActivity, profile
from twins import PlainMOPS, plain_farthest_point_sample

from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.ops.attention import streamed_attention
from mops_lightning.ops.fps import farthest_point_sample
from mops_lightning.ops.sampling_matrix import SamplingMatrix
from mops_lightning.samplers.base import stream_sample
from mops_lightning.samplers.mops import MOPSNet

ROUNDS, WARM_UP = 9, 3
CHUNK = 65536
FARTHEST = ((64, 1024, 32), (64, 1024, 512), (16, 10_000, 1024), (1, 40_960, 4096))

Row = dict[str, Any]


def timed(call: Callable[[], Any]) -> Row:
    """Return the median seconds of a call, the distance of its quartiles, and its peak memory."""
    for _ in range(WARM_UP):
        call()
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    before, seconds = torch.cuda.memory_allocated(), []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        call()
        torch.cuda.synchronize()
        seconds.append(time.perf_counter() - start)
    low, median, high = statistics.quantiles(seconds, n=4, method="inclusive")
    peak = torch.cuda.max_memory_allocated() - before
    return {"ms": 1e3 * median, "spread_ms": 1e3 * (high - low), "peak_mb": peak / 1e6}


def samplers() -> list[Row]:
    """MOPS-Net on one cloud of 40,960 points, and in chunks of 65,536 on 1,000,000."""
    rows = []
    points, many = cloud(40960).cuda(), cloud(1_000_000).cuda()
    for m in (4096, 1024, 256):
        net = MOPSNet(m).cuda().eval()
        found = {"mops": partial(frozen, net, points)}
        found["mops, plain twin"] = partial(frozen, PlainMOPS(net).cuda(), points)
        torch.testing.assert_close(*(call() for call in found.values()), rtol=1e-3, atol=1e-4)
        rows += [{"case": name, "N": 40960, "m": m, **timed(call)} for name, call in found.items()]
        with torch.no_grad():
            chunks = partial(stream_sample, net, partial(many[0].split, CHUNK))
            rows.append({"case": "mops, in chunks", "N": 1_000_000, "m": m, **timed(chunks)})
    return rows


def farthest() -> list[Row]:
    """Farthest point sampling of batches, beside the plain form for one cloud."""
    rows = []
    for clouds, number, m in FARTHEST:
        points = cloud(number, clouds).cuda()
        names = {"clouds": clouds, "N": number, "m": m}
        same = farthest_point_sample(points, m).cpu() == farthest_point_sample(points.cpu(), m)
        call = partial(farthest_point_sample, points, m)
        row = {"case": "fps", **names, **timed(call)}
        rows.append({**row, "rows_as_on_cpu": float(same.float().mean())})
        plain = partial(plain_farthest_point_sample, points[0], m)
        row = {"case": "fps, plain twin", **names, "clouds": 1, **timed(plain)}
        rows.append({**row, "rows_as_on_cpu": 1.0})
    return rows


def products() -> list[Row]:
    """Q = SᵀP, forward and backward: dense, in blocks, by torch's attention; error of bfloat16."""
    rows = []
    for clouds, number, m in ((64, 1024, 32), (64, 1024, 512), (1, 40_960, 4096)):
        queries = torch.randn(m, 128, device="cuda", requires_grad=True)
        keys = torch.rand(clouds, number, 128, device="cuda", requires_grad=True)
        points = cloud(number, clouds).cuda()
        made = {
            "dense": lambda q, k, p: SamplingMatrix(q, k, 1.0)._columns() @ p,
            "blocks": streamed_attention,
            "attention": _attention,
            "attention, bfloat16": lambda q, k, p: _attention(
                q.bfloat16(), k.bfloat16(), p.bfloat16()
            ),
        }
        exact = made["dense"](queries.double(), keys.double(), points.double())
        for name, product in made.items():
            call = partial(_both_ways, product, queries, keys, points)
            error = (product(queries, keys, points) - exact).norm() / exact.norm()
            names = {"case": name, "clouds": clouds, "N": number, "m": m}
            rows.append({**names, **timed(call), "relative_error": float(error)})
    return rows


def _attention(queries: Tensor, keys: Tensor, points: Tensor) -> Tensor:
    each = queries.expand(len(keys), -1, -1)
    wide = F.pad(points, (0, keys.shape[2] - 3))  # fused kernels need one width
    return F.scaled_dot_product_attention(each, keys, wide, scale=1.0)[..., :3]


def _both_ways(
    product: Callable[..., Tensor], queries: Tensor, keys: Tensor, points: Tensor
) -> None:
    queries.grad = keys.grad = None
    product(queries, keys, points).square().sum().backward()


def steps() -> list[Row]:
    """A training step of MOPS-Net for 32 points, and of PointNet; share of it the GPU is busy."""
    rows = []
    for batch in (32, 64, 256, 1024):
        points = cloud(1024, batch).cuda()
        for name, net in (("mops", MOPSNet(32)), ("pointnet", PointNetVanilla(40))):
            call = partial(_step, net.cuda().train(), points)
            row = {"case": name, "batch": batch, **timed(call)}
            with profile(activities=[ProfilerActivity.CUDA]) as found:
                call()
                torch.cuda.synchronize()
            busy = sum(event.self_device_time_total for event in found.key_averages())
            kernels = sum(event.count for event in found.key_averages())
            rows.append({**row, "busy_ms": busy / 1e3, "kernels": kernels})
    return rows


def _step(net: torch.nn.Module, points: Tensor) -> None:
    if isinstance(net, MOPSNet):
        step(net, points)
    else:
        net.zero_grad()
        net(points).square().sum().backward()


ALL = {"samplers": samplers, "farthest": farthest, "products": products, "steps": steps}


def main() -> None:
    """Run all benchmarks and write their record and tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "gpu")
    out = parser.parse_args().out
    torch.manual_seed(0)
    record: Row = {"machine": machine(), "ceiling": ceiling(), "cases": {}}
    where = record["machine"]
    tables = [f"{where['gpu']}, torch {where['versions']['torch']}, float32 without TF32."]
    for name, case in ALL.items():
        rows = record["cases"][name] = case()
        lines = [f"## {name}", "", case.__doc__ or "", "", f"| {' | '.join(rows[0])} |"]
        lines.append("|" + "---|" * len(rows[0]))
        for row in rows:
            cells = (f"{v:.3g}" if isinstance(v, float) else f"{v}" for v in row.values())
            lines.append(f"| {' | '.join(cells)} |")
        tables.append("\n".join(lines))
        print(tables[-1], flush=True)
        out.with_suffix(".json").write_text(json.dumps(record, indent=1) + "\n")
        out.with_suffix(".md").write_text("\n\n".join(tables) + "\n")


if __name__ == "__main__":
    main()
