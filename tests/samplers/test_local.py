"""MOPS-Net with local columns against a dense softmax with −∞ outside the neighbourhoods."""

import pytest
import torch
from torch.testing import assert_close

from mops_lightning import FMOPSNet, MOPSNet
from mops_lightning.errors import UserError
from mops_lightning.ops import local_attention
from mops_lightning.ops.fps import farthest_point_sample
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.anchors import SPACING_POINTS

DOUBLE = torch.float64


def local(kind=MOPSNet, m=6, candidates=4, neighbours=5, **settings):
    """Return a net whose weights are all moved away from their start."""
    torch.manual_seed(0)
    layers = {"feature_channels": (8, 6), "rho_channels": (12, 20)}
    places = {"candidates": candidates, "neighbours": neighbours}
    net = kind(m, anchors="fps", **(layers | places | settings)).double()
    for weights in net.queries.parameters():
        torch.nn.init.normal_(weights, std=0.5)
    return net


def drawn_normal(rng, *shape, dtype=DOUBLE, **options):
    return torch.randn(shape, dtype=dtype, generator=rng, **options)


def farthest(points, m):
    from_centre = points - points.mean(1, keepdim=True)
    start = from_centre.norm(dim=2).argmax(1)
    return farthest_point_sample(points, m, start=start)


def plain_keys(net, points):
    """Return the keys ``(N, C)`` of a cloud ``(N, 3)``."""
    local, global_ = net.features(points[None])
    hidden = net.rho_local(local) + net.rho_global(global_)[:, None]
    return net.rho(net.rho_first(hidden[0]))


def plain_spacing(cloud, order):
    """Return the distance that the sampler takes for the unit of its widths."""
    count = min(SPACING_POINTS, len(cloud))
    chosen = cloud[order[:count]]
    to_last = (chosen[:-1] - chosen[-1]).norm(dim=1)
    return to_last.amin() * (count / SPACING_POINTS) ** 0.5


def plain_column(net, cloud, candidates, keys, j, anchor, unit):
    """Return column j of S ``(N,)``."""
    relation = net.queries.relation @ keys[j]
    query = net.queries.slots[j] + relation / keys.shape[1] ** 0.5
    squares = (cloud[candidates] - anchor).square().sum(1)
    width = unit * net.queries.log_width[j].exp()
    logits = keys @ query - squares / width**2
    if net.queries.neighbours is not None:
        near = squares.argsort(stable=True)[: net.queries.neighbours]
        outside = torch.ones(len(candidates), dtype=torch.bool)
        outside[near] = False
        logits = logits.masked_fill(outside, -torch.inf)
    weights = (logits / net.tau).softmax(0)
    column = torch.zeros(len(cloud), dtype=cloud.dtype)
    return column.index_put((candidates,), weights)


def plain_dense(net, points, m):
    """S ``(B, N, m)``, entry by entry of its definition."""
    n = points.shape[1]
    wanted = n
    if net.queries.candidates is not None:
        wanted = min(net.queries.candidates * net.m, n)
    matrices = []
    for cloud in points:
        order = farthest(cloud[None], n)[0]
        unit = plain_spacing(cloud, order)
        candidates = order[:wanted]
        keys = plain_keys(net, cloud[candidates])
        columns = []
        for j in range(m):
            anchor = cloud[order[j]]
            columns.append(plain_column(net, cloud, candidates, keys, j, anchor, unit))
        matrices.append(torch.stack(columns, 1))
    return torch.stack(matrices)


@pytest.mark.parametrize(
    ("candidates", "neighbours"),
    [
        (4, 5),
        (2, 12),
        (3, None),
        (None, 7),
        (40, 9),
        (12, 5),  # more than the farthest points whose spacing is the unit
        (1, 1),
    ],
)
def test_local_columns_equal_a_dense_softmax_with_infinite_logits_outside(
    candidates, neighbours, rng
):
    net = local(candidates=candidates, neighbours=neighbours, tau_min=0.3)
    net(drawn_normal(rng, 4, 90, 3))  # running statistics
    net.eval()
    points = drawn_normal(rng, 3, 90, 3, requires_grad=True)
    direction = drawn_normal(rng, 3, 6, 3)

    output = net(points)

    dense = plain_dense(net, points, 6)
    expected = dense.mT @ points
    assert_close(output.matrix.dense(), dense)
    assert_close(output.points, expected)
    inputs = [points, *net.parameters()]
    gradients = torch.autograd.grad(output.points, inputs, direction, retain_graph=True)
    expected_gradients = torch.autograd.grad(expected, inputs, direction)
    assert_close(gradients, expected_gradients)
    if neighbours != 1:
        for gradient in expected_gradients:
            assert gradient.abs().max() > 0


def test_local_views_of_s_equal_those_of_the_dense_matrix(rng):
    net = local(m=10, candidates=3, neighbours=8).eval()
    points = drawn_normal(rng, 2, 70, 3)
    values = drawn_normal(rng, 2, 70, 5)

    matrix = net.sampling_matrix(points)

    dense = matrix.dense()
    is_large = dense >= 0.01
    kept = dense.where(is_large, 0.0)
    renormalised = kept / kept.sum(1, keepdim=True)
    assert dense.shape == (2, 70, 10)
    assert_close(dense.sum(1), torch.ones(2, 10, dtype=DOUBLE))
    assert_close(matrix.gram(), dense.mT @ dense)
    assert torch.equal(matrix.nonzero_counts(), is_large.sum(1).double())
    assert_close(matrix.sparse().to_dense(), renormalised)
    assert torch.equal(matrix.first_cloud().dense(), dense[:1])
    assert_close(matrix.sample(values), dense.mT @ values)


def test_local_sparse_keeps_the_largest_entry_of_a_column_without_large_ones(rng):
    net = local(candidates=None, neighbours=60).eval()
    for weights in net.queries.parameters():
        torch.nn.init.constant_(weights, 0)
    net.queries.log_width.data.fill_(9)  # uniform columns
    matrix = net.sampling_matrix(drawn_normal(rng, 1, 80, 3))

    sparse = matrix.sparse(0.5)

    assert sparse.values().tolist() == [1.0, 1.0, 1.0, 1.0, 1.0, 1.0]


def test_local_overlap_equals_that_of_the_dense_matrix(rng):
    net = local(m=10, candidates=3, neighbours=8, overlap=2.0, alpha=0.0)
    points = drawn_normal(rng, 2, 70, 3)

    output = net(points)

    dense = output.matrix.dense()
    gram = (dense.mT @ dense).square()
    diagonal = gram.diagonal(dim1=1, dim2=2).diag_embed()
    off_diagonal = gram - diagonal
    expected = 2.0 * off_diagonal.sum((1, 2)).mean() / 10
    overlap = output.losses["overlap"]
    assert_close(overlap, expected)
    slots = net.queries.slots
    gradient = torch.autograd.grad(overlap, slots, retain_graph=True)
    expected_gradient = torch.autograd.grad(expected, slots)
    assert_close(gradient, expected_gradient)


def test_local_smaller_samples_are_prefixes_with_one_loss_for_each(rng):
    # Of two points there would be six candidates, if they were counted for each size.
    net = local(FMOPSNet, m=16, candidates=3, neighbours=6, overlap=1.0)
    torch.nn.init.constant_(net.queries.log_width, 2.0)  # all neighbours count
    points = drawn_normal(rng, 2, 80, 3)
    of_sizes = net.sample_sizes(points, (2, 16))
    net.eval()

    whole = net(points)
    few = net(points, 2)

    assert_close(few.points, whole.points[:, :2])
    assert_close(few.matrix.dense(), whole.matrix.dense()[..., :2])
    first_two = whole.first(2).matrix
    assert_close(first_two.gram(), few.matrix.gram())
    assert set(of_sizes[2].losses) == {"subset", "overlap"}


def test_local_columns_do_not_depend_on_the_order_of_the_points(rng, randn):
    net = local(m=10, candidates=3, neighbours=8).eval()
    points = randn(1, 70, 3, dtype=DOUBLE)
    order = torch.randperm(70, generator=rng)

    again = net(points[:, order]).points

    assert_close(again, net(points).points)


def test_local_neighbours_by_a_tree_equal_all_distances(rng, monkeypatch):
    points = drawn_normal(rng, 2, 500, 3, dtype=torch.float32)
    queries = points[:, :40]
    by_distances = local_attention.nearest_rows(queries, points, 12)
    monkeypatch.setattr(local_attention, "TREE_MIN_WORK", 0)

    by_tree = local_attention.nearest_rows(queries, points, 12)
    nearest_by_tree = local_attention.nearest_rows(queries, points, 1)

    assert torch.equal(by_tree, by_distances)
    assert nearest_by_tree.shape == (2, 40, 1)


def test_column_weights_in_loops_equal_a_softmax_of_gathered_entries(rng, rand, monkeypatch):
    queries = drawn_normal(rng, 2, 5, 37, requires_grad=True)
    keys = drawn_normal(rng, 2, 9, 37, requires_grad=True)
    points = drawn_normal(rng, 2, 9, 3, requires_grad=True)
    sharpness = rand(2, 5, dtype=torch.float64, requires_grad=True)
    anchors = torch.randint(9, (2, 5), generator=rng)  # some repeat
    places = torch.randint(9, (2, 5, 4), generator=rng)
    inputs = (queries, keys, points, sharpness)

    def columns(queries, keys, points, sharpness):
        entries = local_attention.Entries(points, anchors, places)
        return local_attention.column_weights(queries, keys, entries, sharpness, 3.0)

    weights = columns(*inputs)

    assert torch.autograd.gradcheck(columns, inputs)
    monkeypatch.setattr(local_attention, "_has_loops", lambda _: False)
    assert_close(weights, columns(*inputs))


def test_weighted_sums_equal_those_of_gathered_rows_and_so_do_their_gradients(rng, rand):
    weights = rand(2, 5, 4, dtype=DOUBLE, requires_grad=True)
    values = drawn_normal(rng, 2, 9, 3, requires_grad=True)
    rows = torch.randint(9, (2, 5, 4), generator=rng)  # some repeat

    def sums_of(weights, values):
        return local_attention.weighted_sums(weights, rows, values)

    sums = sums_of(weights, values)

    gathered = gather_points(values, rows)
    expected = (weights[..., None] * gathered).sum(2)
    assert_close(sums, expected)
    assert torch.autograd.gradcheck(sums_of, (weights, values))


def test_column_weights_of_fixed_points_have_the_same_other_gradients(rng, rand):
    queries = drawn_normal(rng, 2, 5, 37, requires_grad=True)
    keys = drawn_normal(rng, 2, 9, 37, requires_grad=True)
    points = drawn_normal(rng, 2, 9, 3, requires_grad=True)
    sharpness = rand(2, 5, dtype=torch.float64, requires_grad=True)
    anchors = torch.randint(9, (2, 5), generator=rng)
    places = torch.randint(9, (2, 5, 4), generator=rng)
    given = rand(2, 5, 4, dtype=torch.float64)
    inputs = (queries, keys, sharpness)

    def gradients(of_points):
        entries = local_attention.Entries(of_points, anchors, places)
        weights = local_attention.column_weights(queries, keys, entries, sharpness, 3.0)
        return torch.autograd.grad(weights, inputs, given)

    of_fixed = gradients(points.detach())

    assert_close(of_fixed, gradients(points), rtol=0, atol=0)


def test_weighted_sums_of_fixed_values_have_the_same_gradient_of_weights(rng, rand):
    weights = rand(2, 5, 4, dtype=DOUBLE, requires_grad=True)
    values = drawn_normal(rng, 2, 9, 3, requires_grad=True)
    rows = torch.randint(9, (2, 5, 4), generator=rng)
    given = drawn_normal(rng, 2, 5, 3)

    def gradient(of_values):
        sums = local_attention.weighted_sums(weights, rows, of_values)
        (of_weights,) = torch.autograd.grad(sums, weights, given)
        return of_weights

    of_fixed = gradient(values.detach())

    assert of_fixed.equal(gradient(values))


def test_local_matched_points_are_chosen_from_all_points(rng):
    net = local(m=4, candidates=1, neighbours=1).float().eval()
    points = drawn_normal(rng, 50, 3, dtype=torch.float32)
    generated, _ = net.downsample(points, readout="generated")

    matched, rows = net.downsample(points, readout="matched")

    nearest = torch.cdist(generated, points).argmin(1)
    assert torch.equal(rows, nearest)
    assert torch.equal(matched, points[nearest])


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_local_columns_in_half_precision_are_near_those_in_single(dtype, rng):
    net = local(m=16, candidates=3, neighbours=6).float().eval()
    for weights in net.queries.parameters():
        torch.nn.init.constant_(weights, 0)
    points = drawn_normal(rng, 2, 100, 3, dtype=torch.float32).to(dtype)
    in_single = net(points.float()).points

    in_half = net.to(dtype)(points).points

    assert in_half.dtype == dtype
    assert_close(in_half.float(), in_single, atol=0.05, rtol=0)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"anchors": None}, "candidates needs anchors=fps, got candidates=4"),
        ({"candidates": 0}, "candidates must be a whole number of at least 1 or null, got 0"),
        ({"neighbours": 2.5}, "neighbours must be a whole number of at least 1 or null, got 2.5"),
        ({"neighbours": True}, "neighbours must be a whole number .* got True"),
    ],
)
def test_local_settings_out_of_range_raise(settings, words):
    arguments = {"anchors": "fps", "candidates": 4, "neighbours": 5}
    with pytest.raises(UserError, match=words):
        MOPSNet(6, **(arguments | settings))


@pytest.mark.parametrize(
    ("columns", "is_thinned"),
    [
        ({"candidates": 2, "neighbours": None}, True),
        ({"candidates": None, "neighbours": 3}, False),
    ],
)
def test_local_columns_of_few_candidates_are_declared(columns, is_thinned):
    assert local(**columns).is_thinned == is_thinned
