"""MOPS-Net on the features of a hierarchical net."""

from functools import partial

import pytest
import torch
from torch.testing import assert_close

from mops_lightning import MOPSNet, StageMOPSNet
from mops_lightning.errors import UserError
from mops_lightning.nets.hierarchical import HierarchicalNet, Stage
from mops_lightning.ops.fps import farthest_point_sample
from mops_lightning.ops.points import gather_points


def moved(net):
    for weights in net.queries.parameters():
        torch.nn.init.normal_(weights, std=0.5)
    return net


def two_stage_net(sampler):
    """Return a net of three classes whose stages keep 12 and 6 points."""
    return HierarchicalNet(3, sampler, points=(12, 6), channels=(8, 10, 12), k=4, hidden=8)


def seven_channels(k, **settings):
    """Return a stage that keeps 5 points and gathers k neighbours, and its sampler."""
    sampler = StageMOPSNet(5, 7, tau_min=1.0, **settings)
    net = moved(sampler).eval()
    torch.nn.init.constant_(net.queries.log_width, 2.0)  # points away from their anchors
    stage = Stage(net, 5, channels_in=7, channels_out=9, k=k)
    return net, stage.eval()


def farthest_order(points, number):
    """Return farthest points of clouds, from the point farthest from the mean."""
    centred = points - points.mean(1, keepdim=True)
    start = centred.norm(dim=2).argmax(1)
    return farthest_point_sample(points, number, start)


def plain_stage(net, points, features, candidates, neighbours):
    """Return the generated points of one cloud by a softmax over all candidates.

    Args:
        net: of five points and 16 key channels.
        points: ``(60, 3)``.
        features: ``(60, C)``.
        candidates: rows of the points that may have weights.
        neighbours: candidates nearest to an anchor, which have weights.
    """
    order = farthest_order(points[None], 60)[0]
    anchors = points[order[:5]]
    places = points[candidates]
    in_order = torch.cdist(anchors, places).argsort(1)
    near = in_order[:, :neighbours]

    local = features[candidates]
    hidden = net.rho_local(local) + net.rho_global(local.amax(0))
    keys = hidden.relu()
    queries = net.queries.slots + keys[:5] @ net.queries.relation.T / 4
    logits = keys @ queries.T

    ordered = points[order]
    last_gap = (ordered[:-1] - ordered[-1]).square().sum(1).amin()
    unit = last_gap * 60 / 64
    squares = torch.cdist(places, anchors).square()
    widths = unit * net.queries.log_width.exp().square()
    logits = logits - squares / widths

    everywhere = torch.ones_like(logits, dtype=torch.bool)
    is_outside = everywhere.scatter(0, near.T, False)
    weights = logits.masked_fill(is_outside, -torch.inf).softmax(0)
    return weights.T @ places


@pytest.mark.parametrize("candidates", [None, 3])
def test_stage_sampler_equals_a_dense_softmax_over_the_host_features(candidates, randn):
    sampler = StageMOPSNet(5, 7, key_channels=16, candidates=candidates, neighbours=6)
    net = moved(sampler).double()
    points = randn(1, 60, 3, dtype=torch.float64)
    features = randn(1, 60, 7, dtype=torch.float64, requires_grad=True)
    (rows,) = farthest_order(points, 60)
    if candidates is not None:
        rows = rows[: candidates * 5]

    (generated,) = net.by_features(points, features, 5).points

    expected = plain_stage(net, points[0], features[0], rows, neighbours=6)
    assert_close(generated, expected)
    squares = generated.square().sum()
    expected_squares = expected.square().sum()
    gradient = torch.autograd.grad(squares, features, retain_graph=True)
    expected_gradient = torch.autograd.grad(expected_squares, features)
    assert_close(gradient, expected_gradient)


def test_stage_sampler_loss_is_alpha_times_the_mean_squared_distance(randn):
    net = StageMOPSNet(5, 7, alpha=3.0)
    points = randn(2, 60, 3)
    features = randn(2, 60, 7)
    output = net.by_features(points, features, 5)
    squares = torch.arange(10.0).view(2, 5)  # with a mean of 4.5

    losses = net.losses_in_stage(output, squares)

    assert losses == {"subset": torch.tensor(13.5)}


def test_stage_sampler_overlap_has_its_weight(randn):
    net = StageMOPSNet(5, 7, overlap=0.25, tau_min=1.0).eval()
    torch.nn.init.constant_(net.queries.log_width, 4.0)  # all neighbours count
    points = randn(2, 60, 3)
    output = net.by_features(points, randn(2, 60, 7), 5)

    losses = net.losses_in_stage(output, torch.zeros(2, 5))

    assert output.matrix is not None
    dense = output.matrix.dense()
    squares = (dense.mT @ dense).square()
    squares.diagonal(dim1=1, dim2=2).zero_()
    expected = 0.25 * squares.sum((1, 2)).mean() / 5
    assert expected > 1e-4
    assert_close(losses["overlap"], expected)


def test_stage_sampler_passes_its_settings_on():
    net = StageMOPSNet(16, 7, candidates=3, neighbours=5, anchor_width=2.0, overlap=0.5)

    assert net.queries.candidates == 3
    assert net.queries.neighbours == 5
    assert net.overlap == 0.5
    # On a surface, 16 points are twice as far apart as the 64 whose spacing is the unit.
    assert net.queries.log_width.exp().tolist() == pytest.approx([4.0] * 16)


def test_hierarchical_net_gives_its_stages_the_distances_to_the_nearest_points(randn):
    sampler = partial(StageMOPSNet, alpha=2.0, neighbours=4)
    net = HierarchicalNet(3, sampler, points=(12,), channels=(8, 10), k=4, hidden=8)
    points = randn(4, 40, 3)

    _, (centres, _) = net.levels(points)

    nearest = torch.cdist(centres, points).amin(2)
    expected = 2.0 * nearest.square().mean()
    assert_close(net.losses["stage1_subset"], expected)


@pytest.mark.parametrize("k", [3, 6])
def test_stage_gathers_the_points_nearest_to_the_anchors(k, randn):
    net, stage = seven_channels(k, neighbours=6)
    points = randn(2, 60, 3)
    features = randn(2, 60, 7)

    centres, _ = stage(points, features)
    output = net.by_features(points, features, 5)
    rows = stage._neighbours(output, points)

    anchor_rows = farthest_order(points, 5)
    anchors = gather_points(points, anchor_rows)
    assert not torch.equal(centres, anchors)
    in_order = torch.cdist(anchors, points).argsort(2)
    from_centres = torch.cdist(centres, points).argsort(2)
    assert rows.equal(in_order[..., :k])
    assert not rows.equal(from_centres[..., :k])


@pytest.mark.parametrize(
    "settings",
    [
        {"neighbours": 3},  # fewer than the stage gathers
        {"neighbours": 6, "candidates": 2},  # not among all points
        {"neighbours": None},
    ],
)
def test_stage_searches_neighbours_that_its_sampler_does_not_know(settings, randn):
    net, stage = seven_channels(4, **settings)
    points = randn(2, 60, 3)
    features = randn(2, 60, 7)
    output = net.by_features(points, features, 5)

    rows = stage._neighbours(output, points)

    in_order = torch.cdist(output.points, points).argsort(2)
    assert rows.equal(in_order[..., :4])


def test_hierarchical_net_trains_its_stages_through_the_host_features(randn):
    sampler = partial(StageMOPSNet, alpha=1.0, neighbours=4, overlap=0.1)
    net = two_stage_net(sampler)
    points = randn(4, 40, 3)

    logits = net(points)
    loss = logits.square().mean() + sum(net.losses.values())
    loss.backward()

    assert logits.shape == (4, 3)
    assert set(net.losses) == {
        "stage1_subset",
        "stage1_overlap",
        "stage2_subset",
        "stage2_overlap",
    }
    for name, weights in net.named_parameters():
        assert weights.grad is not None, name
        assert weights.grad.isfinite().all(), name
    modules = [name for name, _ in net.named_modules()]
    assert not any(name.endswith("sampler.features") for name in modules)


def test_stage_sampler_takes_clouds_with_fewer_points(randn):
    sampler = partial(StageMOPSNet, neighbours=4)
    net = two_stage_net(sampler).eval()
    points = randn(2, 5, 3)

    logits = net(points)

    assert logits.shape == (2, 3)


def test_stage_sampler_starts_near_farthest_points(randn):
    net = StageMOPSNet(50, 4).eval()
    directions = randn(2, 1000, 3)
    points = torch.nn.functional.normalize(directions, dim=2)
    features = randn(2, 1000, 4)

    generated = net.by_features(points, features, 50).points

    anchors = gather_points(points, farthest_order(points, 50))
    apart = (generated - anchors).norm(dim=2)
    assert apart.max() < 0.2


def test_stage_sampler_outside_a_net_is_refused(randn):
    net = StageMOPSNet(5, 7).eval()
    points = randn(1, 60, 3)

    with pytest.raises(UserError, match=r"inside a hierarchical net only.*sampler=mops"):
        net(points)


def test_stage_sampler_has_no_matrix_without_features(randn):
    net = StageMOPSNet(5, 7).eval()

    with pytest.raises(UserError, match=r"inside a hierarchical net only.*sampler=mops"):
        net.sampling_matrix(randn(1, 60, 3))


@pytest.mark.parametrize("name", ["channels", "key_channels"])
def test_stage_sampler_with_no_channels_is_refused(name):
    sizes = {"channels": 7, "key_channels": 16}

    with pytest.raises(UserError, match=f"^{name} must be at least 1, got 0"):
        StageMOPSNet(5, **(sizes | {name: 0}))


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16, torch.float64])
@pytest.mark.parametrize("sampler", [StageMOPSNet, partial(MOPSNet, anchors="fps")])
def test_hierarchical_net_in_another_type_is_near_single_precision(sampler, dtype, randn):
    torch.manual_seed(0)
    net = two_stage_net(sampler).eval()
    points = randn(2, 40, 3)
    expected = net(points)

    logits = net.to(dtype)(points.to(dtype))

    assert logits.dtype == dtype
    assert_close(logits.float(), expected, atol=0.1, rtol=0)


def test_stage_sampler_without_a_host_says_where_it_belongs():
    with pytest.raises(UserError, match="inside a hierarchical net only"):
        StageMOPSNet(m=8)
