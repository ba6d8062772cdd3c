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
from tests.support.samplers import ANCHORED, MOPS_LAYERS


def small(kind=MOPSNet, m=6, moved=False, **settings):
    torch.manual_seed(0)
    arguments = {**ANCHORED, **settings}
    net = kind(m, **arguments)
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
    nearest = distances_to_the_last(points, rows).amin(1)
    share = count / SPACING_POINTS
    return nearest * share**0.5


def distances_to_the_last(points, rows):
    """Return the distances from the last of the chosen points to the others."""
    chosen = gather_points(points, rows)
    others = chosen[:, :-1]
    last = chosen[:, -1:]
    return (others - last).norm(dim=2)


def plain_dense(net, points, keys):
    """S entry by entry of its definition: content of a slot, and distances to its anchor."""
    rows = farthest(points, net.m)
    units = plain_spacing(points)
    clouds = []
    for cloud, keys_of_cloud, rows_of_cloud, unit in zip(points, keys, rows, units, strict=True):
        columns = []
        for j, row in enumerate(rows_of_cloud):
            column = plain_column(net, cloud, keys_of_cloud, j, row, unit)
            columns.append(column)
        matrix = torch.stack(columns, 1)
        clouds.append(matrix)
    return torch.stack(clouds)


def plain_column(net, cloud, keys, j, row, unit):
    """Return column j of S of one cloud, whose anchor is in this row."""
    queries = net.queries
    anchor = cloud[row]
    width = unit * queries.log_width[j].exp()
    key_channels = keys.shape[1]
    relation = queries.relation @ keys[row]
    query = queries.slots[j] + relation / key_channels**0.5
    content = keys @ query
    offsets = cloud - anchor
    squares = offsets.square().sum(1)
    logits = content - squares / width**2
    scaled = logits / net.tau
    return scaled.softmax(0)


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize(
    ("number", "m"),
    [
        (20, 6),
        (90, 6),
        (90, 70),  # more than the farthest points whose spacing is the unit
    ],
)
def test_anchors_equal_dense_softmax_of_distances(training, number, m, randn):
    net = small(m=m, moved=True, tau_min=0.3)
    net.double().train(training)
    points = randn(3, number, 3, dtype=torch.float64, requires_grad=True)
    direction = randn(3, m, 3, dtype=torch.float64)

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
    spacing = distances_to_the_last(points, rows).amin(1, keepdim=True)
    limit = width * spacing
    mean_limit = width * spacing.mean()
    assert (apart < limit).all()
    assert apart.max() > mean_limit / 20


def test_anchors_are_nested_in_size_and_weights(randn):
    points = randn(2, 80, 3)
    net = small(FMOPSNet, m=16, moved=True).eval()

    whole = net(points)
    few = net(points, 5)
    first = whole.first(5)
    first_points = whole.points[:, :5]
    first_columns = whole.matrix.dense()[..., :5]
    gram = few.matrix.gram()
    gram_of_first = first.matrix.gram()
    assert_close(few.points, first_points)
    assert_close(few.matrix.dense(), first_columns)
    assert_close(gram_of_first, gram)


def test_anchors_of_clouds_smaller_than_m_give_fewer_columns(randn):
    points = randn(2, 7, 3)
    net = small(FMOPSNet, m=16, moved=True).eval()

    sampled = net(points, 5).points

    assert sampled.shape == (2, 5, 3)


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
    points_in_single = points.float()
    net = small(m=32).eval()
    torch.nn.init.constant_(net.queries.log_width, -2.0)
    in_single = net(points_in_single).points
    net_in_half = net.to(dtype)

    in_half = net_in_half(points).points

    assert in_half.dtype == dtype
    assert_close(in_half.float(), in_single, atol=0.05, rtol=0)


def test_anchors_warm_start_keeps_their_start():
    plain = MOPSNet(6, **MOPS_LAYERS)
    larger = small(m=9, moved=True)
    weights_of_plain = plain.state_dict()
    weights_of_larger = larger.state_dict()
    net = small()

    copied_from_plain = copy_tensors(weights_of_plain, net)
    copied_from_larger = copy_tensors(weights_of_larger, net)

    first_slots = larger.queries.slots[:6]
    assert "rho_local.weight" in copied_from_plain
    for name in copied_from_plain:
        assert not name.startswith("queries")
    assert "queries.slots" in copied_from_larger
    assert torch.equal(net.queries.slots, first_slots)


@pytest.mark.parametrize("anchors", ["fps", "framed"])
def test_anchors_refuse_chunks(anchors, randn):
    net = small(anchors=anchors).eval()
    points = randn(50, 3)
    chunks = points.split(20)

    with pytest.raises(UserError, match=r"needs all points .* chunks.*without anchors=fps"):
        stream_sample(net, lambda: chunks)


def test_columns_keep_their_distances_far_from_the_origin(randn):
    points = randn(2, 90, 3)
    far = points + 1000
    net = small(tau_min=1.0).eval()

    generated = net(points).points
    generated_far = net(far).points

    moved_back = generated_far - 1000
    assert_close(moved_back, generated, atol=0.01, rtol=0)


def test_columns_of_coincident_points_have_a_least_width():
    points = torch.zeros(1, 80, 3).double()
    points[0, 40:, 0] = 0.002  # two places, 40 points each
    net = small(m=2, tau_min=1.0)
    net.double().eval()

    (generated,) = net(points).points

    # Weights fall off by exp(−d²/s²) with s = 0.001.
    weight = math.exp(-4)
    share_of_other_place = weight / (1 + weight)
    low = 0.002 * share_of_other_place
    high = 0.002 - low
    x_in_order = sorted(generated[:, 0].tolist())
    assert x_in_order == pytest.approx([low, high], rel=1e-4)


def median_width(net, points):
    """Return the median over columns of the standard deviation around their means."""
    matrix = net(points).matrix
    columns = matrix.dense().detach()
    means = columns.mT @ points
    offsets = points[:, :, None] - means[:, None]
    squares = offsets.square().sum(3)
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
