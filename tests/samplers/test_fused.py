"""MOPS-Net without BatchNorm, and in chunks, against the plain layers."""

import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.ops.attention import Partial, attend
from mops_lightning.ops.readout import match
from mops_lightning.samplers.fmops import FMOPSNet
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.samplers.snet import SNet
from mops_lightning.samplers.streaming import global_part, stream_match, stream_sample, sum_part


@pytest.fixture(params=[MOPSNet, FMOPSNet])
def sampler(request, rng):
    """One whose BatchNorm has seen data and has weights of both signs."""
    torch.manual_seed(5)
    made = request.param(24)
    made.train()
    for _ in range(3):
        made(torch.randn(4, 100, 3, generator=rng) * 2 + 1)
    for name, value in made.named_parameters():
        if value.ndim == 1:
            torch.nn.init.normal_(value, 0.5 if name.endswith("bias") else 0.0)
    return made.eval()


@pytest.mark.parametrize(("clouds", "points"), [(3, 40), (2, 2500), (1, 24)])
def test_evaluation_without_gradients_gives_what_the_layers_give(sampler, clouds, points, rng):
    batch = torch.randn(clouds, points, 3, generator=rng)
    plain = sampler(batch)
    with torch.no_grad():
        fast = sampler(batch)
    assert plain.points.requires_grad
    assert not fast.points.requires_grad
    torch.testing.assert_close(fast.points, plain.points.detach(), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(fast.matrix.dense(), plain.matrix.dense(), rtol=1e-3, atol=1e-6)


def test_training_without_gradients_still_uses_the_statistics_of_the_batch(sampler, rng):
    batch = torch.randn(3, 40, 3, generator=rng)
    sampler.train()
    with torch.no_grad():
        fast = sampler(batch).points
    torch.testing.assert_close(fast, sampler(batch).points.detach())


@pytest.mark.parametrize("size", [1, 7, 1000, 5000])
def test_chunks_give_what_the_whole_cloud_gives(sampler, size, rng):
    points = torch.randn(1, 30 if size == 1 else 3000, 3, generator=rng)
    with torch.no_grad():
        whole = sampler(points).points
    streamed = stream_sample(sampler, lambda: points[0].split(size))
    torch.testing.assert_close(streamed, whole[0], rtol=0, atol=1e-5)
    rows = stream_match(streamed, lambda: points[0].split(size))
    assert torch.equal(rows, match(streamed[None], points)[0])


def test_parts_merge_in_any_order_to_the_same_points(sampler, rng):
    points = torch.randn(1000, 3, generator=rng)
    parts = points.split([1, 400, 99, 500])
    net = sampler.fused()
    global_ = torch.stack([global_part(net, part) for part in parts]).amax(0)
    sums = [sum_part(net, part, global_, 24) for part in parts]
    forwards = sums[0].merge(sums[1]).merge(sums[2]).merge(sums[3]).result()
    by_pairs = sums[3].merge(sums[1]).merge(sums[0].merge(sums[2])).result()
    torch.testing.assert_close(forwards, by_pairs, rtol=0, atol=1e-6)
    with torch.no_grad():
        torch.testing.assert_close(forwards, sampler(points[None]).points[0], rtol=0, atol=1e-5)


def test_attend_is_the_softmax_over_points(rng):
    queries = torch.randn(600, 8, generator=rng, dtype=torch.float64) * 5
    keys = torch.randn(2100, 8, generator=rng, dtype=torch.float64) * 5
    values = torch.randn(2100, 3, generator=rng, dtype=torch.float64)
    found = attend(queries, keys, values)
    assert isinstance(found, Partial)
    torch.testing.assert_close(found.result(), (queries @ keys.mT).softmax(1) @ values)


def test_a_smaller_size_streams_the_first_points(rng):
    torch.manual_seed(1)
    sampler = FMOPSNet(24).eval()
    points = torch.randn(200, 3, generator=rng)
    few = stream_sample(sampler, lambda: points.split(64), 5)
    torch.testing.assert_close(few, stream_sample(sampler, lambda: points.split(64))[:5])


@pytest.mark.parametrize(
    ("make", "chunks", "said"),
    [
        (lambda: SNet(4), [torch.zeros(9, 3)], "MOPSNet and FMOPSNet, got SNet"),
        (lambda: MOPSNet(4), [], "number of points N=0"),
        (lambda: MOPSNet(4), [torch.zeros(2, 3), torch.zeros(1, 3)], "number of points N=3"),
        (lambda: MOPSNet(4), [torch.zeros(9, 2)], "shape"),
        (lambda: MOPSNet(4), [torch.zeros(9, 3) / 0], "finite"),
    ],
)
def test_chunks_that_are_no_cloud_are_refused(make, chunks, said):
    with pytest.raises(UserError, match=said):
        stream_sample(make().eval(), lambda: chunks)
