import re
from importlib import import_module
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from torch.testing import assert_close

import mops_lightning.config.compose  # noqa: F401  registers the resolvers
from mops_lightning.config.build import build
from mops_lightning.config.groups import conf_dir
from mops_lightning.errors import UserError
from mops_lightning.ops.precision import restrict_autocast_to_pointwise
from mops_lightning.samplers.fps import FPSSampler

# From the root, as sampler=NAME finds them.
lightn = import_module("benchmarks.rivals.lightn")
csnet = import_module("benchmarks.rivals.csnet")
apes = import_module("benchmarks.rivals.apes")
edge_net = import_module("benchmarks.rivals.edge_net")
samble = import_module("benchmarks.rivals.samble")
selector = import_module("benchmarks.rivals.selector")


def composed(choice):
    """Return a rival as ``sampler=NAME`` builds it."""
    rivals = Path(__file__).parents[2] / "benchmarks" / "rivals" / "conf"
    overrides = [f"hydra.searchpath=[file://{rivals}]", "m=6", *choice]
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        cfg = compose("config", overrides)
    return build(cfg.sampler, "sampler")


CHOICES = {
    "lightn": ["sampler=lightn"],
    "csnet": ["sampler=csnet"],
    "apes": ["sampler=apes"],
    "apes-global": ["sampler=apes", "sampler.variant=global"],
    "apes-all": ["sampler=apes", "sampler.farthest=false"],
    "samble": ["sampler=samble"],
    "samble-all": ["sampler=samble", "sampler.farthest=false"],
}


@pytest.mark.parametrize("choice", CHOICES.values(), ids=CHOICES)
def test_rival_trains_every_weight(choice, randn):
    sampler = composed(choice)
    points = randn(3, 50, 3)

    output = sampler(points)
    seen = output.points
    if output.soft_projected is not None:
        seen = output.soft_projected
    loss = seen.square().sum() + sum(output.losses.values())
    loss.backward()

    for name, weights in sampler.named_parameters():
        assert weights.grad is not None, name
        assert weights.grad.any(), name


@pytest.mark.parametrize("choice", CHOICES.values(), ids=CHOICES)
def test_rival_ignores_order_of_points(choice, rng, randn):
    # In float64: SAMBLE selects 6 of 12 points by scores that are nearly equal.
    sampler = composed(choice).double()
    points = randn(3, 50, 3).double()
    order = torch.randperm(50, generator=rng)
    sampler(points)  # running statistics
    sampler.eval()

    sampled = sampler(points)
    sampled_in_order = sampler(points[:, order])

    assert sampled.points.shape == (3, 6, 3)
    assert_close(sampled_in_order.points, sampled.points)
    if not sampler.generates:
        assert torch.equal(order[sampled_in_order.indices], sampled.indices)


def test_self_correlation_equals_plain_sums(randn):
    cloud = randn(7, 4)

    (correlation,) = lightn.self_correlation(cloud[None])

    for row, found in zip(cloud, correlation, strict=True):
        products = (cloud * row).sum(1)
        shares = (products / 2).exp()
        weighted = shares[:, None] * cloud
        assert_close(found, weighted.sum(0) / shares.sum())


def test_offset_attention_equals_plain_attention(randn):
    features = randn(2, 40, 8).requires_grad_()
    net = csnet.OffsetAttention(8)
    queries, keys, values = net.projections(features).chunk(3, 2)
    attended = (queries @ keys.mT / 8**0.5).softmax(2) @ values
    expected = features + net.offset(features - attended)
    found = net(features)
    assert_close(found, expected)
    weights = [features, *net.parameters()]
    toward = randn(2, 40, 8)
    gradients = (torch.autograd.grad(x, weights, toward) for x in (found, expected))
    assert_close(*gradients)


def test_soft_top_k_is_sigmoid_above_threshold_that_gives_k(randn):
    scores = randn(40)
    low = -50.0
    high = 50.0
    for _ in range(60):
        middle = (low + high) / 2
        degrees = (2 * scores / 0.5 - middle).sigmoid()
        if degrees.sum() > 9:
            low = middle
        else:
            high = middle

    (found,) = selector.soft_top_k(scores[None], 9, 0.5, iterations=200)

    assert_close(found, degrees, atol=1e-4, rtol=0)


@pytest.mark.parametrize(("variant", "neighbours"), [("local", 4), ("global", 20)])
def test_apes_scores_equal_plain_attention_in_feature_space(variant, neighbours, randn):
    features = randn(20, 6)
    sampling = apes.EdgeSampling(6, variant, k=4)

    scores, _, _ = sampling(features[None])

    expected = torch.zeros(20)
    for i, away in enumerate(torch.cdist(features, features)):
        near = away.argsort()[:neighbours]
        keys = sampling.keys(features[near] - features[i])
        query = sampling.queries(features[i])
        weights = (keys @ query / 6**0.5).softmax(0)
        if variant == "local":
            expected[i] = weights.std(unbiased=False)
        else:
            expected[near] += weights
    assert_close(scores[0], expected)


def test_edge_convolution_equals_plain_maximum_over_neighbours(randn):
    features = randn(10, 4)
    features[7] = features[2]  # a copy
    layer = edge_net.EdgeConvolution(4, 5, 6, k=3).eval()

    (convolved,) = layer(features[None])

    for i, away in enumerate(torch.cdist(features, features)):
        centre = features[i]
        edges = []
        for j in away.argsort()[:3]:
            difference = features[j] - centre
            edges.append(torch.cat([centre, difference]))
        values = layer.rest(layer.first(torch.stack(edges)))
        assert_close(convolved[i], values.max(0).values)


def test_edge_net_in_mixed_precision_is_close_to_full_precision(randn):
    points = randn(2, 40, 3)
    embedding = edge_net.EdgeEmbedding((16, 16), 8, k=4).eval()
    attention = edge_net.NeighbourAttention(8, heads=2, expansion=4, k=4).eval()
    expected = attention(embedding(points))

    with torch.autocast("cpu", torch.bfloat16), restrict_autocast_to_pointwise("cpu"):
        mixed = attention(embedding(points))

    assert mixed.dtype == torch.float32
    assert not torch.equal(mixed, expected)
    assert_close(mixed, expected, atol=0.05, rtol=0.05)


def test_neighbour_attention_equals_plain_heads_over_differences(randn):
    features = randn(9, 8)
    block = edge_net.NeighbourAttention(8, heads=2, expansion=4, k=3)

    (attended,) = block.attend(features[None])

    for i, away in enumerate(torch.cdist(features, features)):
        near = away.argsort()[:3]
        differences = features[near] - features[i]
        keys = block.keys(differences)
        values = block.values(differences)
        query = block.queries(features[i])
        heads = []
        for channels in (slice(0, 4), slice(4, 8)):
            logits = keys[:, channels] @ query[channels] / 2
            heads.append(logits.softmax(0) @ values[:, channels])
        expected = torch.cat(heads)
        assert_close(attended[i], expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"heads": 3}, "channels must be even and a multiple of heads=3, got 128."),
        ({"channels": 9, "heads": 3}, "channels must be even and a multiple of heads=3, got 9."),
        ({"momentum": 2.0}, "momentum must be at most 1, got 2.0."),
    ],
)
def test_samble_refuses_arguments_out_of_range(change, message):
    with pytest.raises(UserError, match=re.escape(message)):
        samble.SAMBLE(8, **change)


def test_csnet_refuses_to_have_no_layer():
    message = "feature_channels must be sizes of at least 1 layer, each at least 1, got []."
    with pytest.raises(UserError, match=re.escape(message)):
        csnet.CSNet(8, feature_channels=[])


@pytest.mark.parametrize("name", ["apes", "samble"])
def test_selection_is_from_all_points_without_farthest(name, randn):
    points = randn(2, 200, 3)
    sampler = composed([f"sampler={name}", "sampler.farthest=false"]).eval()

    output = sampler(points)

    first_rows, second_rows = output.indices
    assert output.indices.max() > 100
    assert len(first_rows.unique()) == 6
    assert len(second_rows.unique()) == 6
    assert_close(output.points[1], points[1][second_rows])


@pytest.mark.parametrize("name", ["apes", "samble"])
def test_selection_is_from_four_times_as_many_farthest_points(name, randn):
    points = randn(2, 200, 3)
    sampler = composed([f"sampler={name}"]).eval()
    candidates = FPSSampler(24, start="farthest")(points).indices

    output = sampler(points)

    for rows, allowed in zip(output.indices, candidates, strict=True):
        assert len(rows.unique()) == 6
        assert torch.isin(rows, allowed).all()


@pytest.mark.parametrize("variant", ["local", "global"])
def test_apes_gives_kept_points_the_attended_values(variant, randn):
    features = randn(9, 8)
    sampler = apes.APES(2, variant, k=4, channels=8)
    _, weights, near = sampler.sampling[0](features[None])
    kept = torch.tensor([[7, 0, 3]])

    (attended,) = sampler.attended_values(features[None], weights, near, kept)

    for found, i in zip(attended, kept[0], strict=True):
        seen = features[near[0, i]]
        if variant == "local":
            seen = seen - features[i]
        expected = weights[0, i] @ sampler.values(seen)
        assert_close(found, expected, atol=1e-5, rtol=1e-5)


def test_samble_scores_equal_plain_columns_over_neighbours(rand):
    attention = rand(1, 8, 8)
    rows = rand(1, 8, 8).argsort(2)[..., :3]

    (scores,) = samble.sparse_scores(attention, rows)

    for column in range(8):
        total = 0.0
        count = 0
        for i in range(8):
            if column in rows[0, i]:
                total += float(attention[0, i, column])
                count += 1
        expected = total / max(count, 1) ** 2
        assert float(scores[column]) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("weights", "available", "m", "want"),
    [
        ([1.0, 1.0, 1.0], [4, 4, 4], 6, [2, 2, 2]),
        ([3.0, 1.0, 0.0], [4, 4, 4], 4, [3, 1, 0]),
        ([0.1, 0.2, 0.3], [7, 7, 7], 6, [1, 2, 3]),  # in float32 slightly below 1, 2 and 3
        ([9.0, 1.0, 1.0], [4, 4, 4], 8, [4, 2, 2]),  # the first bin is full
        ([0.0, 0.0, 0.0], [2, 4, 6], 6, [2, 2, 2]),
        ([5.0, 0.0, 0.0], [2, 0, 6], 7, [2, 0, 5]),
        ([1.0, 2.0, 3.0], [3, 1, 2], 6, [3, 1, 2]),  # all points
        ([1.0, 1.0, 1.0], [3, 4, 4], 7, [2, 3, 2]),  # two are missing after rounding
    ],
)
def test_samble_allots_points_by_weight_and_room(weights, available, m, want):
    got = samble.allot(torch.tensor([weights]), torch.tensor([available]).float(), m)

    assert got.tolist() == [want]


def test_samble_takes_highest_priorities_of_every_bin(rng, randn):
    priorities = randn(2, 12)
    bins = torch.randint(0, 3, (2, 12), generator=rng)
    bins[:, :6] = torch.tensor([0, 0, 1, 1, 2, 2])
    counts = torch.tensor([[2, 1, 2], [1, 2, 2]])

    rows = samble.chosen_rows(priorities, bins, counts)

    for cloud in range(2):
        expected = set()
        for number in range(3):
            (members,) = torch.where(bins[cloud] == number)
            by_priority = priorities[cloud, members].argsort(descending=True)
            highest = members[by_priority][: counts[cloud, number]]
            expected.update(highest.tolist())
        assert set(rows[cloud].tolist()) == expected


def test_samble_boundaries_divide_first_batch_equally_then_move_slowly(rng):
    layer = samble.BinSampling(4, bins=4, k=3, temperature=0.1, momentum=0.9)
    scores = torch.arange(40.0).flip(0).view(2, 20)

    layer._move_boundaries(scores)
    first = layer.boundaries.clone()
    layer._move_boundaries(scores + 10)

    assert first.tolist() == [29.0, 19.0, 9.0]
    assert_close(layer.boundaries, first + 1)
