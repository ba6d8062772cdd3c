"""MOPS-Net with local columns against a dense softmax with −∞ outside the neighbourhoods."""

import pytest
import torch

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


def farthest(points, m):
    start = (points - points.mean(1, keepdim=True)).norm(dim=2).argmax(1)
    return farthest_point_sample(points, m, start=start)


def plain_dense(net, points, m):
    """S ``(B, N, m)``, entry by entry of its definition."""
    matrices = []
    n = points.shape[1]
    count = min(SPACING_POINTS, n)
    wanted = n if net.queries.candidates is None else min(net.queries.candidates * net.m, n)
    for cloud in points:
        order = farthest(cloud[None], n)[0]
        chosen = cloud[order[:count]]
        unit = (chosen[:-1] - chosen[-1]).norm(dim=1).amin() * (count / SPACING_POINTS) ** 0.5
        candidates = order[:wanted]
        local, global_ = net.features(cloud[None, candidates])
        hidden = net.rho_local(local) + net.rho_global(global_)[:, None]
        keys = net.rho(net.rho_first(hidden[0]))
        columns = []
        for j in range(m):
            anchor = cloud[order[j]]
            query = net.queries.slots[j] + net.queries.relation @ keys[j] / keys.shape[1] ** 0.5
            squares = (cloud[candidates] - anchor).square().sum(1)
            width = unit * net.queries.log_width[j].exp()
            logits = keys @ query - squares / width**2
            if net.queries.neighbours is not None:
                near = squares.argsort(stable=True)[: net.queries.neighbours]
                outside = torch.ones(wanted, dtype=torch.bool)
                outside[near] = False
                logits = logits.masked_fill(outside, -torch.inf)
            column = torch.zeros(n, dtype=cloud.dtype)
            columns.append(column.index_put((candidates,), (logits / net.tau).softmax(0)))
        matrices.append(torch.stack(columns, 1))
    return torch.stack(matrices)


@pytest.mark.parametrize(
    ("candidates", "neighbours"), [(4, 5), (2, 12), (3, None), (None, 7), (40, 9), (1, 1)]
)
def test_local_columns_equal_a_dense_softmax_with_infinite_logits_outside(
    candidates, neighbours, rng
):
    net = local(candidates=candidates, neighbours=neighbours, tau_min=0.3)
    net(torch.randn(4, 90, 3, dtype=DOUBLE, generator=rng))  # running statistics
    net.eval()
    points = torch.randn(3, 90, 3, dtype=DOUBLE, generator=rng, requires_grad=True)
    direction = torch.randn(3, 6, 3, dtype=DOUBLE, generator=rng)

    output = net(points)
    want = plain_dense(net, points, 6)

    torch.testing.assert_close(output.matrix.dense(), want)
    torch.testing.assert_close(output.points, want.mT @ points)
    inputs = [points, *net.parameters()]
    got = torch.autograd.grad((output.points * direction).sum(), inputs, retain_graph=True)
    expected = torch.autograd.grad(((want.mT @ points) * direction).sum(), inputs)
    torch.testing.assert_close(got, expected)
    if neighbours != 1:
        assert all(gradient.abs().max() > 0 for gradient in expected)


def test_local_views_of_s_equal_those_of_the_dense_matrix(rng):
    net = local(m=10, candidates=3, neighbours=8).eval()
    points = torch.randn(2, 70, 3, dtype=DOUBLE, generator=rng)

    matrix = net.sampling_matrix(points)

    dense = matrix.dense()
    assert dense.shape == (2, 70, 10)
    torch.testing.assert_close(dense.sum(1), torch.ones(2, 10, dtype=DOUBLE))
    torch.testing.assert_close(matrix.gram(), dense.mT @ dense)
    assert torch.equal(matrix.nonzero_counts(), (dense >= 0.01).sum(1).double())
    kept = dense.where(dense >= 0.01, 0.0)
    torch.testing.assert_close(matrix.sparse().to_dense(), kept / kept.sum(1, keepdim=True))
    assert torch.equal(matrix.first_cloud().dense(), dense[:1])
    values = torch.randn(2, 70, 5, dtype=DOUBLE, generator=rng)
    torch.testing.assert_close(matrix.sample(values), dense.mT @ values)


def test_local_sparse_keeps_the_largest_entry_of_a_column_without_large_ones(rng):
    net = local(candidates=None, neighbours=60).eval()
    for weights in net.queries.parameters():
        torch.nn.init.constant_(weights, 0)
    net.queries.log_width.data.fill_(9)  # uniform columns

    sparse = net.sampling_matrix(torch.randn(1, 80, 3, dtype=DOUBLE, generator=rng)).sparse(0.5)

    assert sparse.values().tolist() == [1.0] * 6


def test_local_overlap_equals_that_of_the_dense_matrix(rng):
    net = local(m=10, candidates=3, neighbours=8, overlap=2.0, alpha=0.0)
    points = torch.randn(2, 70, 3, dtype=DOUBLE, generator=rng)
    output = net(points)
    dense = output.matrix.dense()
    gram = (dense.mT @ dense).square()
    off_diagonal = gram - gram.diagonal(dim1=1, dim2=2).diag_embed()

    want = 2.0 * off_diagonal.sum((1, 2)).mean() / 10

    torch.testing.assert_close(output.losses["overlap"], want)
    slots = net.queries.slots
    got = torch.autograd.grad(output.losses["overlap"], slots, retain_graph=True)
    torch.testing.assert_close(got, torch.autograd.grad(want, slots))


def test_local_smaller_samples_are_prefixes_with_one_loss_for_each(rng):
    # Of two points there would be six candidates, if they were counted for each size.
    net = local(FMOPSNet, m=16, candidates=3, neighbours=6, overlap=1.0)
    torch.nn.init.constant_(net.queries.log_width, 2.0)  # all neighbours count
    points = torch.randn(2, 80, 3, dtype=DOUBLE, generator=rng)
    losses = net.sample_sizes(points, (2, 16))
    net.eval()

    whole = net(points)
    few = net(points, 2)

    torch.testing.assert_close(few.points, whole.points[:, :2])
    torch.testing.assert_close(few.matrix.dense(), whole.matrix.dense()[..., :2])
    torch.testing.assert_close(whole.first(2).matrix.gram(), few.matrix.gram())
    assert set(losses[2].losses) == {"subset", "overlap"}


def test_local_columns_do_not_depend_on_the_order_of_the_points(rng):
    net = local(m=10, candidates=3, neighbours=8).eval()
    points = torch.randn(1, 70, 3, dtype=DOUBLE, generator=rng)
    order = torch.randperm(70, generator=rng)

    again = net(points[:, order]).points

    torch.testing.assert_close(again, net(points).points)


def test_local_neighbours_by_a_tree_equal_all_distances(rng, monkeypatch):
    points = torch.randn(2, 500, 3, generator=rng)
    want = local_attention.nearest_rows(points[:, :40], points, 12)

    monkeypatch.setattr(local_attention, "TREE_MIN_WORK", 0)

    assert torch.equal(local_attention.nearest_rows(points[:, :40], points, 12), want)
    assert local_attention.nearest_rows(points[:, :40], points, 1).shape == (2, 40, 1)


def test_local_products_in_loops_equal_gathered_keys(rng):
    queries = torch.randn(2, 5, 37, dtype=DOUBLE, generator=rng, requires_grad=True)
    keys = torch.randn(2, 9, 37, dtype=DOUBLE, generator=rng, requires_grad=True)
    places = torch.randint(9, (2, 5, 4), generator=rng)
    gathered = gather_points(keys, places)

    products = local_attention.chosen_products(queries, keys, places)

    torch.testing.assert_close(products, (gathered * queries[:, :, None]).sum(3))
    assert torch.autograd.gradcheck(
        lambda left, right: local_attention.chosen_products(left, right, places), (queries, keys)
    )


def test_weighted_sums_equal_those_of_gathered_rows_and_so_do_their_gradients(rng):
    weights = torch.rand(2, 5, 4, dtype=torch.float64, generator=rng, requires_grad=True)
    values = torch.randn(2, 9, 3, dtype=torch.float64, generator=rng, requires_grad=True)
    rows = torch.randint(9, (2, 5, 4), generator=rng)  # some repeat

    sums = local_attention.weighted_sums(weights, rows, values)

    gathered = gather_points(values, rows)
    torch.testing.assert_close(sums, (weights[..., None] * gathered).sum(2))
    assert torch.autograd.gradcheck(
        lambda left, right: local_attention.weighted_sums(left, rows, right), (weights, values)
    )


def test_local_matched_points_are_chosen_from_all_points(rng):
    net = local(m=4, candidates=1, neighbours=1).float().eval()
    points = torch.randn(50, 3, generator=rng)
    generated, _ = net.downsample(points, readout="generated")

    matched, rows = net.downsample(points, readout="matched")

    assert torch.equal(rows, torch.cdist(generated, points).argmin(1))
    assert torch.equal(matched, points[rows])


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_local_columns_in_half_precision_are_near_those_in_single(dtype, rng):
    net = local(m=16, candidates=3, neighbours=6).float()
    for weights in net.queries.parameters():
        torch.nn.init.constant_(weights, 0)
    points = torch.randn(2, 100, 3, generator=rng).to(dtype)
    want = net.eval()(points.float()).points

    found = net.to(dtype)(points).points

    assert found.dtype == dtype
    torch.testing.assert_close(found.float(), want, atol=0.05, rtol=0)


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
