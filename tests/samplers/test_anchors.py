"""MOPS-Net with anchors against farthest points and a dense softmax of distances."""

import math

import pytest
import torch
from torch.testing import assert_close

from mops_lightning import FMOPSNet, MOPSNet
from mops_lightning.errors import UserError
from mops_lightning.ops import attention
from mops_lightning.ops.fps import farthest_point_sample
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.anchors import SPACING_POINTS
from mops_lightning.samplers.base import stream_sample
from mops_lightning.training.recipe.warm_start import copy_tensors


def small(kind=MOPSNet, m=6, moved=False, **settings):
    torch.manual_seed(0)
    layers = {"feature_channels": (8, 6), "rho_channels": (12, 10)}
    net = kind(m, anchors="fps", **(layers | settings))
    if moved:
        for weights in net.queries.parameters():
            torch.nn.init.normal_(weights, std=0.5)
    return net


def farthest(points, m):
    """Farthest points, the first being farthest from the mean, one cloud at a time."""
    from_centre = points - points.mean(1, keepdim=True)
    start = from_centre.norm(dim=2).argmax(1)
    return farthest_point_sample(points, m, start=start)


def plain_spacing(points):
    """Return for each cloud the distance that is the unit of the widths of columns."""
    count = min(SPACING_POINTS, points.shape[1])
    rows = farthest(points, count)
    chosen = gather_points(points, rows)
    to_last = chosen[:, :-1] - chosen[:, -1:]
    nearest = to_last.norm(dim=2).amin(1)
    return nearest * (count / SPACING_POINTS) ** 0.5


def plain_dense(net, points, keys):
    """S entry by entry of its definition: content of a slot, and distances to its anchor."""
    rows = farthest(points, net.m)
    units = plain_spacing(points)
    clouds = []
    for cloud, keys_of_cloud, rows_of_cloud, unit in zip(points, keys, rows, units, strict=True):
        columns = []
        for j, row in enumerate(rows_of_cloud):
            columns.append(plain_column(net, cloud, keys_of_cloud, j, row, unit))
        clouds.append(torch.stack(columns, 1))
    return torch.stack(clouds)


def plain_column(net, cloud, keys, j, row, unit):
    """Return column j of S of one cloud, whose anchor is in this row."""
    relation = net.queries.relation @ keys[row]
    query = net.queries.slots[j] + relation / keys.shape[1] ** 0.5
    width = unit * net.queries.log_width[j].exp()
    squares = (cloud - cloud[row]).square().sum(1)
    logits = keys @ query - squares / width**2
    return (logits / net.tau).softmax(0)


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("number", [20, 90])
def test_anchors_equal_dense_softmax_of_distances(training, number, randn):
    net = small(moved=True, tau_min=0.3).double().train(training)
    points = randn(3, number, 3, dtype=torch.float64, requires_grad=True)
    direction = randn(3, 6, 3, dtype=torch.float64)

    output = net(points)

    assert output.matrix is not None
    keys = output.matrix.keys[..., :10]
    dense = plain_dense(net, points, keys)
    expected = dense.mT @ points
    assert_close(output.matrix.dense(), dense)
    assert_close(output.points, expected)
    parameters = list(net.queries.parameters())
    gradients = torch.autograd.grad(output.points, parameters, direction, retain_graph=True)
    expected_gradients = torch.autograd.grad(expected, parameters, direction)
    for gradient in expected_gradients:
        assert gradient.abs().max() > 0
    assert_close(gradients, expected_gradients)


@pytest.mark.parametrize("m", [50, 200])
@pytest.mark.parametrize("width", [0.3, 0.8])
def test_untrained_anchors_are_near_farthest_points(width, m, randn):
    directions = randn(3, 1000, 3)
    points = torch.nn.functional.normalize(directions, dim=2)
    net = small(m=m, tau_min=0.5, anchor_width=width).eval()

    sampled = net(points).points

    rows = farthest(points, m)
    anchors = gather_points(points, rows)
    apart = (sampled - anchors).norm(dim=2)
    to_last = anchors[:, :-1] - anchors[:, -1:]
    spacing = to_last.norm(dim=2).amin(1, keepdim=True)
    assert (apart < width * spacing).all()
    assert apart.max() > width * spacing.mean() / 20


def test_anchors_are_nested_in_size_and_weights(randn):
    points = randn(2, 80, 3)
    net = small(FMOPSNet, m=16, moved=True).eval()

    whole = net(points)
    few = net(points, 5)
    # More points than a smaller cloud has are not needed for fewer columns.
    of_small_clouds = net(points[:, :7], 5)

    first = whole.first(5)
    assert_close(few.points, whole.points[:, :5])
    assert_close(few.matrix.dense(), whole.matrix.dense()[..., :5])
    assert_close(first.matrix.gram(), few.matrix.gram())
    assert of_small_clouds.points.shape == (2, 5, 3)


def test_anchors_of_large_clouds_are_computed_in_blocks(randn, monkeypatch):
    points = randn(2, 60, 3).double()  # gradients of widths cancel in float32
    direction = randn(2, 6, 3).double()
    net = small(moved=True).double()
    parameters = list(net.queries.parameters())
    whole = net(points).points
    expected = torch.autograd.grad(whole, parameters, direction)
    monkeypatch.setitem(attention.BLOCKS, "cpu", attention.Blocks(0, 4, 10))

    by_blocks = net(points).points

    assert_close(by_blocks, whole, atol=1e-12, rtol=0)
    gradients = torch.autograd.grad(by_blocks, parameters, direction)
    assert_close(gradients, expected, atol=1e-9, rtol=1e-9)


def test_anchors_with_fused_layers_equal_layers(randn):
    net = small(moved=True)
    for _ in range(3):
        net(randn(4, 50, 3))
    net.eval()
    points = randn(2, 50, 3)

    with torch.no_grad():
        fast = net(points).points

    expected = net(points).points.detach()
    assert_close(fast, expected, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_anchors_in_half_precision_keep_distances(dtype, randn):
    points = randn(2, 100, 3).to(dtype)
    net = small(m=32).eval()
    net.queries.log_width.data.fill_(-2.0)
    in_single = net(points.float()).points

    in_half = net.to(dtype)(points).points

    assert in_half.dtype == dtype
    assert_close(in_half.float(), in_single, atol=0.05, rtol=0)


def test_anchors_warm_start_keeps_their_start():
    plain = MOPSNet(6, feature_channels=(8, 6), rho_channels=(12, 10))
    larger = small(m=9, moved=True)
    net = small()

    copied_from_plain = copy_tensors(plain.state_dict(), net)
    copied_from_larger = copy_tensors(larger.state_dict(), net)

    assert "rho_local.weight" in copied_from_plain
    for name in copied_from_plain:
        assert not name.startswith("queries")
    assert "queries.slots" in copied_from_larger
    assert torch.equal(net.queries.slots, larger.queries.slots[:6])


def test_anchors_refuse_chunks(randn):
    net = small().eval()
    points = randn(50, 3)

    with pytest.raises(UserError, match=r"needs all points .* chunks.*without anchors=fps"):
        stream_sample(net, lambda: points.split(20))


def test_columns_keep_their_distances_far_from_the_origin(randn):
    points = randn(2, 90, 3)
    far = points + 1000
    net = small(tau_min=1.0).eval()

    generated = net(points).points
    generated_far = net(far).points

    assert_close(generated_far - 1000, generated, atol=0.01, rtol=0)


def test_columns_of_coincident_points_have_a_least_width():
    points = torch.zeros(1, 80, 3)
    points[0, 40:, 0] = 0.002  # two places, 40 points each
    net = small(m=2, tau_min=1.0).double().eval()

    (generated,) = net(points.double()).points

    # Weights fall off by exp(−d²/s²) with s = 0.001.
    weight = math.exp(-4)
    share_of_other_place = weight / (1 + weight)
    low = 0.002 * share_of_other_place
    high = 0.002 - low
    assert sorted(generated[:, 0].tolist()) == pytest.approx([low, high], rel=1e-4)


def median_width(net, points):
    """Return the median over columns of the standard deviation around their means."""
    columns = net(points).matrix.dense().detach()
    means = columns.mT @ points
    squares = (points[:, :, None] - means[:, None]).square().sum(3)
    variances = (columns * squares).sum(1)
    return variances.sqrt().median()


def test_untrained_columns_are_as_wide_as_the_spacing_of_their_points(rand):
    plane = rand(1, 4000, 3)
    plane[..., 2] = 0
    of_16 = small(m=16, anchor_width=0.5, tau_min=1.0).eval()
    of_64 = small(m=64, anchor_width=0.5, tau_min=1.0).eval()

    wide = median_width(of_16, plane)
    narrow = median_width(of_64, plane)

    # A quarter of the points on the same plane are twice as far apart.
    assert wide / narrow == pytest.approx(2.0, rel=0.2)
