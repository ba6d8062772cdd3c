from importlib import import_module
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir

import mops_lightning.config.compose  # noqa: F401  registers the resolvers
from mops_lightning.config.build import build
from mops_lightning.config.groups import conf_dir

# From the root, as sampler=NAME finds them.
lightn = import_module("benchmarks.rivals.lightn")
csnet = import_module("benchmarks.rivals.csnet")
apes = import_module("benchmarks.rivals.apes")
edge_net = import_module("benchmarks.rivals.edge_net")
samble = import_module("benchmarks.rivals.samble")
selector = import_module("benchmarks.rivals.selector")


@pytest.mark.parametrize(
    "choice", ["lightn", "csnet", "apes", "apes sampler.variant=global", "samble"]
)
def test_rival_trains_every_weight_and_ignores_order_of_points(choice, rng):
    rivals = Path(__file__).parents[2] / "benchmarks" / "rivals" / "conf"
    settings = [f"hydra.searchpath=[file://{rivals}]", "m=6", *f"sampler={choice}".split()]
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        sampler = build(compose("config", settings).sampler, "sampler")
    points, order = torch.randn(3, 50, 3, generator=rng), torch.randperm(50, generator=rng)
    output = sampler(points)
    seen = output.points if output.soft_projected is None else output.soft_projected
    (seen.square().sum() + sum(output.losses.values())).backward()
    assert all(p.grad is not None and p.grad.any() for p in sampler.parameters())
    chosen, turned = sampler.eval()(points), sampler(points[:, order])
    assert chosen.points.shape == (3, 6, 3)
    torch.testing.assert_close(turned.points, chosen.points, atol=1e-4, rtol=1e-4)
    assert sampler.generates or torch.equal(order[turned.indices], chosen.indices)


def test_self_correlation_equals_plain_sums(rng):
    cloud = torch.randn(7, 4, generator=rng)
    for row, got in zip(cloud, lightn.self_correlation(cloud[None])[0], strict=True):
        shares = (cloud * row).sum(1).div(2).exp()
        torch.testing.assert_close(got, (shares[:, None] * cloud).sum(0) / shares.sum())


def test_soft_top_k_is_sigmoid_above_threshold_that_gives_k(rng):
    scores, low, high = torch.randn(40, generator=rng), -50.0, 50.0
    for _ in range(60):
        middle = (low + high) / 2
        degrees = (2 * scores / 0.5 - middle).sigmoid()
        low, high = (middle, high) if degrees.sum() > 9 else (low, middle)
    got = selector.soft_top_k(scores[None], 9, 0.5, iterations=200)[0]
    torch.testing.assert_close(got, degrees, atol=1e-4, rtol=0)


@pytest.mark.parametrize("variant", ["local", "global"])
def test_apes_scores_equal_plain_attention_in_feature_space(variant, rng):
    features = torch.randn(20, 6, generator=rng)
    sampling = apes.EdgeSampling(6, variant, k=4)

    scores, _, _ = sampling(features[None])

    want = torch.zeros(20)
    for i, away in enumerate(torch.cdist(features, features)):
        near = away.argsort()[: 4 if variant == "local" else 20]
        keys = sampling.keys(features[near] - features[i])
        weights = (keys @ sampling.queries(features[i]) / 6**0.5).softmax(0)
        if variant == "local":
            want[i] = weights.std(unbiased=False)
        else:
            want[near] += weights
    torch.testing.assert_close(scores[0], want)


def test_edge_convolution_equals_plain_maximum_over_neighbours(rng):
    features = torch.randn(10, 4, generator=rng)
    features[7] = features[2]  # a copy
    layer = edge_net.EdgeConvolution(4, 5, 6, k=3).eval()

    got = layer(features[None])[0]

    for i, away in enumerate(torch.cdist(features, features)):
        edges = [torch.cat([features[i], features[j] - features[i]]) for j in away.argsort()[:3]]
        want = layer.layers(torch.stack(edges)).max(0).values
        torch.testing.assert_close(got[i], want)


def test_neighbour_attention_equals_plain_heads_over_differences(rng):
    features = torch.randn(9, 8, generator=rng)
    block = edge_net.NeighbourAttention(8, heads=2, expansion=4, k=3)

    got = block.attend(features[None])[0]

    for i, away in enumerate(torch.cdist(features, features)):
        differences = features[away.argsort()[:3]] - features[i]
        keys = block.keys(differences)
        values = block.values(differences)
        query = block.queries(features[i])
        heads = []
        for part in (slice(0, 4), slice(4, 8)):
            weights = (keys[:, part] @ query[part] / 2).softmax(0)
            heads.append(weights @ values[:, part])
        torch.testing.assert_close(got[i], torch.cat(heads), atol=1e-5, rtol=1e-5)


def test_apes_selects_from_all_points_in_two_stages(rng):
    points = torch.randn(2, 200, 3, generator=rng)
    sampler = apes.APES(5, k=4, channels=16)

    output = sampler.eval()(points)

    assert output.indices.max() > 100
    assert all(len(set(rows.tolist())) == 5 for rows in output.indices)
    torch.testing.assert_close(output.points[1], points[1][output.indices[1]])


def test_samble_scores_equal_plain_columns_over_neighbours(rng):
    attention = torch.rand(1, 8, 8, generator=rng)
    rows = torch.rand(1, 8, 8, generator=rng).argsort(2)[..., :3]

    got = samble.sparse_scores(attention, rows)[0]

    for column in range(8):
        paid = [float(attention[0, i, column]) for i in range(8) if column in rows[0, i]]
        assert float(got[column]) == pytest.approx(sum(paid) / max(len(paid), 1) ** 2)


@pytest.mark.parametrize(
    ("weights", "available", "m", "want"),
    [
        ([1.0, 1.0, 1.0], [4, 4, 4], 6, [2, 2, 2]),
        ([3.0, 1.0, 0.0], [4, 4, 4], 4, [3, 1, 0]),
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


def test_samble_takes_highest_priorities_of_every_bin(rng):
    priorities = torch.randn(2, 12, generator=rng)
    bins = torch.randint(0, 3, (2, 12), generator=rng)
    bins[:, :6] = torch.tensor([0, 0, 1, 1, 2, 2])
    counts = torch.tensor([[2, 1, 2], [1, 2, 2]])

    got = samble.chosen_rows(priorities, bins, counts)

    for cloud in range(2):
        want = set()
        for number in range(3):
            members = [row for row in range(12) if bins[cloud, row] == number]
            highest = sorted(members, key=priorities[cloud].tolist().__getitem__, reverse=True)
            want |= set(highest[: int(counts[cloud, number])])
        assert set(got[cloud].tolist()) == want


def test_samble_boundaries_divide_first_batch_equally_then_move_slowly(rng):
    layer = samble.BinSampling(4, bins=4, k=3, temperature=0.1, momentum=0.9)
    scores = torch.arange(40.0).flip(0).view(2, 20)

    layer._move_boundaries(scores)
    first = layer.boundaries.clone()
    layer._move_boundaries(scores + 10)

    assert first.tolist() == [29.0, 19.0, 9.0]
    torch.testing.assert_close(layer.boundaries, first + 1)
