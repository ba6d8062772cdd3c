from typing import Any

import numpy as np
import pytest
import torch

from mops_lightning import FPSSampler, MOPSNet, PoissonSampler, RandomSampler, SNet, VoxelSampler
from mops_lightning.errors import UserError
from mops_lightning.ops.points import gather_points
from mops_lightning.ops.weights import curvature


@pytest.fixture
def net():
    return MOPSNet(8).eval()


@pytest.fixture
def clouds():
    """Three clouds of 20, 40 and 20 points, far from the origin and large."""
    rng = torch.Generator().manual_seed(0)
    return [50 + 10 * torch.rand(number, 3, generator=rng) for number in (20, 40, 20)]


@pytest.mark.parametrize("readout", ["matched", "completed"])
def test_indices_are_rows_of_the_input(net, clouds, readout):
    for cloud in clouds:
        points, indices = net.downsample(cloud, readout=readout)

        assert points.shape == (8, 3)
        assert torch.equal(points, cloud[indices])
        if readout == "completed":
            assert len(indices.unique()) == 8


def test_generated_points_are_in_the_unit_of_the_input(net, clouds):
    cloud = clouds[1]

    points, indices = net.downsample(cloud, readout="generated")

    centre = cloud.double().mean(0)
    centred = cloud - centre
    radius = centred.norm(dim=1).max()
    in_unit_sphere = (centred / radius).float()
    with torch.no_grad():
        (generated,) = net(in_unit_sphere[None]).points
    expected = generated * radius + centre
    assert indices is None
    assert points.dtype == torch.float32
    assert torch.allclose(points, expected.float(), atol=1e-4)


def test_shift_and_scale_change_nothing(net, clouds):
    cloud = clouds[0].double()
    moved_cloud = 1000 * cloud + 1e6

    _, indices = net.downsample(cloud)
    points, moved_indices = net.downsample(moved_cloud)

    assert torch.equal(moved_indices, indices)
    assert points.dtype == torch.float64


@pytest.fixture
def batch():
    """The cloud of each point of the three clouds, when they are joined."""
    return torch.arange(3).repeat_interleave(torch.tensor([20, 40, 20]))


@pytest.mark.parametrize("readout", ["generated", "completed"])
def test_batch_gives_the_same_as_single_clouds(net, clouds, batch, readout):
    joined = torch.cat(clouds)
    single = []
    for cloud in clouds:
        points, _ = net.downsample(cloud, readout=readout)
        single.append(points)

    flat, rows = net.downsample(joined, None, readout, batch=batch)

    assert torch.allclose(flat, torch.cat(single))
    if readout == "generated":
        assert rows is None
    else:
        assert torch.equal(joined[rows], flat)


def test_small_clouds_are_returned_whole(clouds, batch):
    sampler = FPSSampler(30)

    points, rows = sampler.downsample(torch.cat(clouds), batch=batch)

    numbers = batch[rows].bincount()
    assert numbers.tolist() == [20, 30, 20]
    assert torch.equal(points[:20], clouds[0])
    assert rows[:20].tolist() == list(range(20))
    assert len(rows.unique()) == 70


def test_arrays_in_arrays_out(net, clouds):
    cloud = clouds[0]
    expected_points, expected_rows = net.downsample(cloud)

    points, rows = net.downsample(cloud.numpy())

    assert isinstance(points, np.ndarray)
    assert np.array_equal(points, expected_points.numpy())
    assert np.array_equal(rows, expected_rows.numpy())


def test_arrays_of_any_byte_order_and_read_only_arrays(net, clouds):
    array = clouds[0].numpy()
    big_endian = array.astype(">f4")
    read_only = array.copy()
    read_only.flags.writeable = False
    backwards = array[::-1].copy()
    with_negative_strides = backwards[::-1]
    _, expected = net.downsample(array)

    for same in (big_endian, read_only, with_negative_strides):
        _, rows = net.downsample(same)
        assert np.array_equal(rows, expected)


def test_arrays_of_double_precision_in_and_out(net, clouds):
    cloud = clouds[0].double().numpy()

    points, rows = net.downsample(cloud, readout="generated")

    assert points.dtype == np.float64
    assert rows is None


def test_whole_numbers_of_numpy_are_sizes(net, clouds):
    batch = np.repeat([0, 1], 10)

    points, _ = net.downsample(clouds[0].numpy(), np.int64(8), batch=batch)

    assert points.shape == (16, 3)


@pytest.mark.parametrize("dtype", ["uint16", "uint32", "uint64", "int32"])
def test_batch_of_any_whole_numbers(net, clouds, dtype):
    batch = np.repeat([0, 1], 10)
    _, expected = net.downsample(clouds[0], batch=batch)

    _, rows = net.downsample(clouds[0], batch=batch.astype(dtype))

    assert torch.equal(rows, expected)


def test_double_precision_sampler_takes_any_points(net, clouds):
    _, expected = net.downsample(clouds[0])

    points, indices = net.double().downsample(clouds[0])

    assert torch.equal(indices, expected)
    assert points.dtype == torch.float32


MANY = torch.rand(2, 20, 3)
ONE = torch.rand(20, 3)
TEXTS = np.array([["a", "a", "a"]])

WRONG_POINTS = {
    "type": ([1.0], "points must be a tensor or an array, got list"),
    "integers": (MANY.long(), r"floating point, got torch.int64. Try"),
    "objects": (TEXTS, "points must hold numbers"),
    "shape": (ONE[0], r"shape \(N, 3\) or \(B, N, 3\), got \(3,\)"),
    "columns": (torch.rand(20, 4), r"got \(20, 4\)"),
    "empty": (ONE[:0], "at least one cloud and one point"),
    "not finite": (MANY / 0, "finite"),
    "too few": (MANY[:, :5], "number of points N=5, got m=8"),
}
WRONG_SETTINGS: dict[str, tuple[dict[str, Any], str]] = {
    "m": ({"m": 9}, "m must be 8"),
    "m text": ({"m": "9"}, "m must be a whole number"),
    "readout": ({"readout": "matchd"}, "Did you mean 'matched'"),
}
WRONG_BATCHES = {
    "batch type": (ONE, torch.ones(20), "batch must be whole numbers"),
    "batch list": (ONE, [[1], [2, 3]], "batch must be whole numbers, got"),
    "batch and many": (MANY, [0] * 20, "with batch"),
    "batch size": (ONE, [0], r"shape \(P=20,\)"),
    "batch order": (ONE, [1] + [0] * 19, "ascending"),
    "batch below 0": (ONE, [-1] * 10 + [0] * 10, "at least 0"),
    "batch without points": (ONE[:0], torch.zeros(0).long(), "points must have at least one cloud"),
    "batch gap": (ONE, [0] * 10 + [2] * 10, "cloud 1 has no points"),
}


def check_refusal(net, words, points, **arguments):
    with pytest.raises(UserError, match=words) as refused:
        net.downsample(points, **arguments)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("mistake", WRONG_POINTS)
def test_wrong_points_get_one_line(net, mistake):
    points, words = WRONG_POINTS[mistake]

    check_refusal(net, words, points)


@pytest.mark.parametrize("mistake", WRONG_SETTINGS)
def test_wrong_settings_get_one_line(net, mistake):
    settings, words = WRONG_SETTINGS[mistake]

    check_refusal(net, words, MANY, **settings)


@pytest.mark.parametrize("mistake", WRONG_BATCHES)
def test_wrong_batches_get_one_line(net, mistake):
    points, batch, words = WRONG_BATCHES[mistake]

    check_refusal(net, words, points, batch=batch)


TRAINED = "net"
"""Stands for the fixture among samplers."""


@pytest.mark.parametrize(
    "sampler",
    [
        FPSSampler(8),
        PoissonSampler(8),
        RandomSampler(8),
        TRAINED,
    ],
)
def test_weights_of_single_batched_and_ragged_clouds_agree(sampler, net, rand):
    if sampler == TRAINED:
        sampler = net
    points = 9 * rand(3, 40, 3)
    weight = rand(3, 40)
    weight[1, ::2] = 0  # left out
    batch = torch.arange(3).repeat_interleave(40)
    joined = points.flatten(0, 1).numpy()
    joined_weight = weight.flatten().numpy()

    chosen, rows = sampler.downsample(points, weight=weight)
    _, joined_rows = sampler.downsample(joined, batch=batch, weight=joined_weight)

    assert torch.equal(chosen, gather_points(points, rows))
    weight_of_chosen = weight.gather(1, rows)
    assert (weight_of_chosen > 0).all()
    first_rows = 40 * torch.arange(3)
    expected_rows = rows + first_rows[:, None]
    assert joined_rows.tolist() == expected_rows.flatten().tolist()
    for i in range(3):
        _, rows_alone = sampler.downsample(points[i], weight=weight[i])
        assert torch.equal(rows_alone, rows[i])
        assert len(rows_alone.unique()) == 8


@pytest.mark.parametrize("weight", [None, "curvature", "numbers"])
def test_clouds_of_sizes_in_turn_are_sampled_by_their_own_weights(weight, rand):
    sizes = [30, 8, 40, 30, 8, 40]  # 8 points are as many as are kept
    clouds = [rand(size, 3) for size in sizes]
    given: list[Any] = [weight] * len(sizes)
    joined: Any = weight
    if weight == "numbers":
        given = [rand(size) for size in sizes]
        joined = torch.cat(given)
    batch = torch.arange(6).repeat_interleave(torch.tensor(sizes))
    sampler = FPSSampler(8)

    chosen, _ = sampler.downsample(torch.cat(clouds), batch=batch, weight=joined)

    expected = []
    for cloud, weight_of_cloud in zip(clouds, given, strict=True):
        points, _ = sampler.downsample(cloud, weight=weight_of_cloud)
        expected.append(points)
    assert torch.equal(chosen, torch.cat(expected))


def test_weights_by_curvature_are_those_of_each_cloud(rand):
    points = rand(90, 3)
    weight = curvature(points.numpy())
    twice = torch.cat([points, points])
    batch = torch.arange(180) // 90
    sampler = FPSSampler(8)
    _, expected = sampler.downsample(points, weight=weight)

    _, rows = sampler.downsample(points, weight="curvature")
    _, rows_of_both = sampler.downsample(twice, batch=batch, weight="curvature")

    assert torch.equal(rows, expected)
    assert torch.equal(rows_of_both[:8], expected)


@pytest.mark.parametrize(
    ("weight", "said"),
    [
        (torch.ones(39), r"shape \(40,\)"),
        ("density", "must be 'curvature' or numbers, got 'density'"),
        (torch.arange(40) < 7, "7 points have a weight above 0, fewer than m=8"),
        (torch.ones(5), "m must be at most the number of points N=5, got m=8"),
    ],
)
def test_weights_that_cannot_be_used_are_rejected(weight, said):
    number = 5 if "N=5" in said else 40
    points = torch.rand(number, 3)

    with pytest.raises(UserError, match=said):
        RandomSampler(8).downsample(points, weight=weight)


@pytest.mark.parametrize("weight", [None, "curvature", torch.ones(40)])
def test_points_that_are_not_finite_are_rejected(weight):
    points = torch.rand(40, 3)
    points[3] = torch.nan

    with pytest.raises(UserError, match="points must be finite"):
        RandomSampler(8).downsample(points, weight=weight)


def test_weights_for_other_methods_and_samplers_in_training_mode_are_rejected(net):
    points = torch.rand(40, 3)
    weight = torch.ones(40)

    with pytest.raises(UserError, match="VoxelSampler takes no weights"):
        VoxelSampler(8).downsample(points, weight=weight)
    for readout in ("generated", "matched"):
        with pytest.raises(UserError, match=f"{readout} readout takes no weights"):
            net.downsample(points, readout=readout, weight=weight)
    with pytest.raises(UserError, match=r"call eval\(\)"):
        SNet(8).downsample(points)
