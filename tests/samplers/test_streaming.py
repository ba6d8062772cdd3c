import pytest
import torch
from torch.testing import assert_close

from mops_lightning import FMOPSNet, MOPSNet, SNet
from mops_lightning.errors import UserError
from mops_lightning.samplers import fused
from mops_lightning.samplers.base import stream_sample


@pytest.mark.parametrize("size", [1, 7, 1000, 5000])
def test_stream_sample_equals_whole_cloud(trained, size, randn):
    number = 30 if size == 1 else 3000
    cloud = randn(number, 3)
    with torch.no_grad():
        (whole,) = trained(cloud[None]).points

    streamed = stream_sample(trained, lambda: cloud.split(size))

    assert_close(streamed, whole, rtol=0, atol=1e-5)


def test_stream_sample_of_a_sampler_in_training_mode_is_that_of_evaluation(randn):
    torch.manual_seed(1)
    sampler = MOPSNet(8)
    sampler.train()
    chunks = randn(200, 3).split(64)

    in_training = stream_sample(sampler, lambda: chunks)
    in_evaluation = stream_sample(sampler.eval(), lambda: chunks)

    assert torch.equal(in_training, in_evaluation)


def test_stream_sample_of_chunks_in_parts_equals_whole_cloud(trained, randn, monkeypatch):
    monkeypatch.setattr(fused, "PART", 700)  # the last part has 200 points
    cloud = randn(3000, 3)
    cloud[2999] = torch.tensor([9.0, -9.0, 9.0])  # its features are among the largest
    with torch.no_grad():
        (whole,) = trained(cloud[None]).points

    streamed = stream_sample(trained, lambda: cloud.split(1600))

    assert_close(streamed, whole, rtol=0, atol=1e-5)


def test_stream_sample_is_nested(randn):
    torch.manual_seed(1)
    sampler = FMOPSNet(24).eval()
    chunks = randn(200, 3).split(64)

    few = stream_sample(sampler, lambda: chunks, 5)
    all_points = stream_sample(sampler, lambda: chunks)

    assert_close(few, all_points[:5])


def test_stream_sample_takes_a_cloud_of_as_many_points_as_it_returns(randn):
    torch.manual_seed(1)
    sampler = MOPSNet(8).eval()
    cloud = randn(8, 3)
    with torch.no_grad():
        (whole,) = sampler(cloud[None]).points

    streamed = stream_sample(sampler, lambda: cloud.split(3))

    assert_close(streamed, whole)


@pytest.mark.parametrize(
    ("make", "chunks", "message"),
    [
        (lambda: SNet(4), [torch.zeros(9, 3)], "^SNet needs all points .* cannot sample in chunks"),
        (lambda: MOPSNet(4), [], "number of points N=0"),
        (lambda: MOPSNet(4), [torch.zeros(2, 3), torch.zeros(1, 3)], "number of points N=3"),
        (lambda: MOPSNet(4), [torch.zeros(9, 2)], "shape"),
        (lambda: MOPSNet(4), [torch.zeros(9, 3) / 0], "finite"),
        (lambda: MOPSNet(8), [torch.rand(9, 3).double()], "torch.float32 like the sampler's"),
        (lambda: FMOPSNet(4), [torch.zeros(9, 3)], "m must be between 1 and 4, got 5"),
    ],
)
def test_stream_sample_invalid_input_raises(make, chunks, message):
    with pytest.raises(UserError, match=message):
        stream_sample(make().eval(), lambda: chunks, 5 if "got 5" in message else None)


@pytest.mark.parametrize(("clouds", "points"), [(3, 40), (2, 2500), (1, 24)])
def test_fused_evaluation_equals_layers(trained, clouds, points, randn):
    batch = randn(clouds, points, 3)

    plain = trained(batch)
    with torch.no_grad():
        fast = trained(batch)

    assert plain.points.requires_grad
    assert not fast.points.requires_grad
    assert_close(fast.points, plain.points.detach(), rtol=1e-4, atol=1e-5)
    assert_close(fast.matrix.dense(), plain.matrix.dense(), rtol=1e-3, atol=1e-6)


def test_training_without_gradients_uses_batch_statistics(trained, randn):
    batch = randn(3, 40, 3)
    trained.train()

    with torch.no_grad():
        fast = trained(batch).points

    expected = trained(batch).points.detach()
    assert_close(fast, expected)
