"""The way back: maps of nearest sampled points, and values that follow them."""

import numpy as np
import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.ops.propagation import PropagationMap, propagate, propagation_map

LABELS = [np.int64, np.uint32, np.uint16, np.uint8, np.bool_]


def plain_map(points, sampled, k):
    """Sort all distances; weights are 1/d²."""
    distances = torch.cdist(
        points.double(), sampled.double(), compute_mode="donot_use_mm_for_euclid_dist"
    )
    near, rows = distances.sort(dim=1)
    inverse = near[:, :k] ** -2
    return rows[:, :k], inverse / inverse.sum(1, keepdim=True)


@pytest.mark.parametrize("k", [1, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_map_has_nearest_rows_and_inverse_square_weights(k, dtype, rng):
    points, sampled = torch.rand(200, 3, generator=rng), torch.rand(30, 3, generator=rng)
    made = propagation_map(points.to(dtype), sampled.to(dtype), k)
    rows, weights = plain_map(points, sampled, k)
    assert torch.equal(made.rows, rows)
    torch.testing.assert_close(made.weights, weights.to(dtype), rtol=1e-4, atol=1e-6)
    assert made.m == 30


def test_sampled_points_keep_their_values(rng):
    points = torch.rand(80, 3, generator=rng)
    chosen = torch.randperm(80, generator=rng)[:20]
    scores = torch.rand(20, 4, generator=rng)
    for k in (1, 5):
        carried = propagate(scores, propagation_map(points, points[chosen], k))
        assert torch.equal(carried[chosen], scores)


def test_ragged_clouds_equal_clouds_one_by_one(rng):
    sizes, m = [40, 25], [8, 6]
    clouds = [torch.rand(size, 3, generator=rng) for size in sizes]
    labels = [torch.randint(9, (number,), generator=rng) for number in m]
    samples = [cloud[:number] for cloud, number in zip(clouds, m, strict=True)]
    alone = [
        propagate(own, propagation_map(cloud, sample, 3))
        for own, cloud, sample in zip(labels, clouds, samples, strict=True)
    ]
    batch, sampled_batch = (torch.arange(2).repeat_interleave(torch.tensor(n)) for n in (sizes, m))
    flat = propagation_map(torch.cat(clouds), torch.cat(samples), 3, batch, sampled_batch)
    assert torch.equal(propagate(torch.cat(labels), flat), torch.cat(alone))


def test_batch_equals_clouds_one_by_one(rng):
    clouds, samples = torch.rand(2, 20, 3, generator=rng), torch.rand(2, 6, 3, generator=rng)
    dense = propagation_map(clouds, samples, 2)
    values = torch.rand(2, 6, 5, generator=rng)
    for cloud in range(2):
        one = propagation_map(clouds[cloud], samples[cloud], 2)
        assert torch.equal(propagate(values, dense)[cloud], propagate(values[cloud], one))


@pytest.mark.parametrize("kind", LABELS)
@pytest.mark.parametrize("k", [1, 4])
def test_labels_stay_exact(kind, k, rng):
    points, sampled = (torch.rand(n, 3, generator=rng).numpy() for n in (90, 12))
    labels = (np.arange(12) % (2 if kind is np.bool_ else 5)).astype(kind)
    made = propagation_map(points, sampled, k)
    carried = propagate(labels, made)
    assert carried.dtype == labels.dtype
    for row, weights, label in zip(made.rows.tolist(), made.weights.tolist(), carried, strict=True):
        votes = dict.fromkeys(labels[row], 0.0)
        for own, weight in zip(labels[row], weights, strict=True):
            votes[own] += weight
        assert votes[label] == pytest.approx(max(votes.values()))


def test_columns_vote_one_by_one_and_colours_are_averaged_on_request():
    made = PropagationMap(torch.tensor([[0, 1, 2]]), torch.tensor([[0.4, 0.35, 0.25]]), 3)
    colours = np.array([[0, 200], [100, 0], [100, 0]], np.uint8)
    assert propagate(colours, made).tolist() == [[100, 0]]
    mean = propagate(colours, made, mean=True)
    assert (mean.tolist(), mean.dtype) == ([[60, 80]], np.uint8)


def test_gradients_flow_to_features(rng):
    values = torch.rand(6, 2, generator=rng, dtype=torch.float64, requires_grad=True)
    made = propagation_map(torch.rand(9, 3, generator=rng).double(), torch.rand(6, 3).double(), 3)
    assert torch.autograd.gradcheck(lambda features: propagate(features, made), values)


ROWS = np.zeros((5, 2), np.int32)


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"m": np.array(3)}, r"is no map: .*rows \(N, k\) and m of at least 1, got m"),
        ({"rows": ROWS}, "is no map"),
        ({"rows": ROWS / 2, "m": np.array(3)}, "must hold whole numbers"),
        ({"rows": ROWS[0], "m": np.array(3)}, "is no map"),
        ({"rows": ROWS[:, :0], "m": np.array(3)}, "is no map"),
        ({"rows": ROWS, "m": np.array([3, 3])}, "is no map"),
        ({"rows": ROWS, "m": np.array(-3)}, "m of at least 1"),
        ({"rows": ROWS[:, :1] + 3, "m": np.array(3)}, "rows must be from -1 to 2, got 3 to 3"),
        ({"rows": ROWS[:, :1] - 2, "m": np.array(3)}, "rows must be from -1 to 2, got -2"),
        (
            {"rows": ROWS[:, :1] - 1, "m": np.array(3)},
            "5 points have no finite coordinates.* fill=0",
        ),
        ({"rows": ROWS[:, :1], "m": np.array(4)}, r"each of 4 sampled points, shape \(4,\), got"),
        ({"rows": ROWS, "m": np.array(3)}, "weights must be finite"),
        ({"rows": ROWS, "m": np.array(3), "weights": ROWS * np.nan}, "weights must be finite"),
    ],
)
def test_bad_map_gets_one_line(arrays, said, tmp_path):
    np.savez(tmp_path / "map.npz", **arrays)
    with pytest.raises(UserError, match=said) as error:
        propagate(np.arange(3), tmp_path / "map.npz")
    assert "\n" not in str(error.value)


def test_missing_or_broken_map_gets_one_line(tmp_path):
    with pytest.raises(UserError, match=r"no file .*map.npz\. Write it by downsample --map"):
        propagate(np.arange(3), tmp_path / "map.npz")
    (tmp_path / "map.npz").write_bytes(b"PK" * 40)
    with pytest.raises(UserError, match=r"map.npz is broken"):
        propagate(np.arange(3), tmp_path / "map.npz")
    with pytest.raises(UserError, match="map must be a PropagationMap or a file, got dict"):
        propagate(np.arange(3), {"rows": 3})


POINTS = torch.rand(6, 3)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"k": 5}, "k must be from 1 to the number of sampled points, 4, got 5"),
        ({"k": 0}, "k must be from 1"),
        ({"sampled": POINTS[None]}, "sampled must be floating point of 2 dimensions"),
        ({"sampled": POINTS[:, :2]}, "same number of coordinates, got 3 and 2"),
        ({"points": POINTS.long()}, "points must be floating point"),
        ({"points": POINTS * torch.nan}, "must be finite"),
        ({"points": "scan.ply"}, "points must be a tensor or an array, got str"),
        ({"batch": [0] * 6}, "batch and sampled_batch belong together"),
        ({"batch": [0, 1] * 3, "sampled_batch": [0] * 4}, "batch must be ascending"),
        (
            {"batch": [0] * 5, "sampled_batch": [0] * 4},
            r"batch must be whole numbers of shape \(P=6",
        ),
        ({"batch": [0] * 6, "sampled_batch": [0, 0, 1, 1]}, "as many clouds, got 1 and 2"),
    ],
)
def test_wrong_argument_gets_one_line(arguments, said):
    with pytest.raises(UserError, match=said):
        propagation_map(**{"points": POINTS, "sampled": POINTS[:4], **arguments})
