"""The way back: maps of nearest sampled points, and values that follow them."""

from fractions import Fraction

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from mops_lightning.errors import UserError
from mops_lightning.ops.propagation import PropagationMap, propagate, propagation_map

LABELS = [np.int64, np.uint32, np.uint16, np.uint8, np.bool_]


def plain_map(points, sampled, k):
    """Sort all distances; weights are 1/d²."""
    distances = torch.cdist(
        points.double(),
        sampled.double(),
        compute_mode="donot_use_mm_for_euclid_dist",
    )
    near, rows = distances.sort(dim=1)
    inverse = near[:, :k] ** -2
    weights = inverse / inverse.sum(1, keepdim=True)
    return rows[:, :k], weights


@pytest.mark.parametrize("k", [1, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_map_has_nearest_rows_and_inverse_square_weights(k, dtype, rand):
    points = rand(200, 3)
    sampled = rand(30, 3)
    rows, weights = plain_map(points, sampled, k)

    made = propagation_map(points.to(dtype), sampled.to(dtype), k)

    assert torch.equal(made.rows, rows)
    assert_close(made.weights, weights.to(dtype), rtol=1e-4, atol=1e-6)
    assert made.m == 30


@pytest.mark.parametrize("k", [1, 5])
def test_sampled_points_keep_their_values(k, rng, rand):
    points = rand(80, 3)
    chosen = torch.randperm(80, generator=rng)[:20]
    scores = rand(20, 4)

    made = propagation_map(points, points[chosen], k)
    carried = propagate(scores, made)

    assert torch.equal(carried[chosen], scores)


def test_ragged_clouds_equal_clouds_one_by_one(rng, rand):
    first = rand(40, 3)
    second = rand(25, 3)
    sample_of_first = first[:8]
    sample_of_second = second[:6]
    labels = torch.randint(9, (14,), generator=rng)
    points = torch.cat([first, second])
    batch = torch.tensor([0] * 40 + [1] * 25)
    sampled = torch.cat([sample_of_first, sample_of_second])
    sampled_batch = torch.tensor([0] * 8 + [1] * 6)

    flat = propagation_map(points, sampled, 3, batch, sampled_batch)
    carried = propagate(labels, flat)

    map_of_first = propagation_map(first, sample_of_first, 3)
    map_of_second = propagation_map(second, sample_of_second, 3)
    assert torch.equal(carried[:40], propagate(labels[:8], map_of_first))
    assert torch.equal(carried[40:], propagate(labels[8:], map_of_second))


@pytest.mark.parametrize("cloud", [0, 1])
def test_batch_equals_clouds_one_by_one(cloud, rand):
    points = rand(2, 20, 3)
    samples = rand(2, 6, 3)
    values = rand(2, 6, 5)

    made = propagation_map(points, samples, 2)
    carried = propagate(values, made)

    map_alone = propagation_map(points[cloud], samples[cloud], 2)
    carried_alone = propagate(values[cloud], map_alone)
    assert torch.equal(carried[cloud], carried_alone)


@pytest.mark.parametrize("kind", LABELS)
@pytest.mark.parametrize("k", [1, 4])
def test_labels_stay_exact(kind, k, rand):
    points = rand(90, 3).numpy()
    sampled = rand(12, 3).numpy()
    number_of_labels = 2 if kind is np.bool_ else 5
    labels = (np.arange(12) % number_of_labels).astype(kind)
    made = propagation_map(points, sampled, k)

    carried = propagate(labels, made)

    assert carried.dtype == labels.dtype
    for row, weights, label in zip(made.rows, made.weights, carried, strict=True):
        labels_near = labels[row.numpy()]
        votes = dict.fromkeys(labels_near, 0.0)
        for neighbour, weight in zip(labels_near, weights, strict=True):
            votes[neighbour] += float(weight)
        assert votes[label] == pytest.approx(max(votes.values()))


def test_columns_vote_one_by_one_and_colours_are_averaged_on_request():
    rows = torch.tensor([[0, 1, 2]])
    weights = torch.tensor([[0.4, 0.35, 0.25]])
    made = PropagationMap(rows, weights, 3)
    colours = np.array([[0, 200], [100, 0], [100, 0]], np.uint8)

    voted = propagate(colours, made)
    mean = propagate(colours, made, mean=True)

    assert voted.tolist() == [[100, 0]]
    assert mean.tolist() == [[60, 80]]
    assert mean.dtype == np.uint8


def test_vote_that_is_tied_is_won_by_the_nearer_point_and_among_equals_by_the_lowest_row():
    sampled = np.zeros((4, 3))
    sampled[0, 0] = 1
    sampled[1, 0] = -1
    sampled[2, 1] = 2
    sampled[3, 1] = -2
    origin = np.zeros((1, 3))
    equally_far = propagation_map(origin, sampled, 2)
    rows = torch.tensor([[1, 0, 2]])
    weights = torch.tensor([[0.5, 0.25, 0.25]])
    one_is_nearer = PropagationMap(rows, weights, 4)
    labels = np.array([7, 3, 7, 5])

    voted = propagate(labels, equally_far)
    voted_by_the_nearer = propagate(labels, one_is_nearer)

    assert voted.tolist() == [7]
    assert voted_by_the_nearer.tolist() == [3]


def test_gradients_flow_to_features(rand):
    points = rand(9, 3, dtype=torch.float64)
    sampled = rand(6, 3, dtype=torch.float64)
    features = rand(6, 2, dtype=torch.float64, requires_grad=True)
    made = propagation_map(points, sampled, 3)

    def carried(features):
        return propagate(features, made)

    assert torch.autograd.gradcheck(carried, features)


ROWS = np.zeros((5, 2), np.int32)
COLUMN = ROWS[:, :1]
NO_SUCH_MAP = "is no map"
OUT_OF_RANGE = "rows must be from -1 to 2, got"


M = np.array(3)


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"m": M}, r"is no map: .*rows \(N, k\) and m of at least 1, got m"),
        ({"rows": ROWS}, NO_SUCH_MAP),
        ({"rows": ROWS / 2, "m": M}, "must hold whole numbers"),
        ({"rows": ROWS[0], "m": M}, NO_SUCH_MAP),
        ({"rows": ROWS[:, :0], "m": M}, NO_SUCH_MAP),
        ({"rows": ROWS, "m": np.array([3, 3])}, NO_SUCH_MAP),
        ({"rows": ROWS, "m": -M}, "m of at least 1"),
        ({"rows": COLUMN + 3, "m": M}, f"{OUT_OF_RANGE} 3 to 3"),
        ({"rows": COLUMN - 2, "m": M}, f"{OUT_OF_RANGE} -2"),
        ({"rows": COLUMN - 1, "m": M}, "5 points have no finite coordinates.* fill=0"),
        ({"rows": COLUMN, "m": np.array(4)}, r"each of 4 sampled points, shape \(4,\), got"),
        ({"rows": ROWS, "m": M}, "weights must be finite"),
        ({"rows": ROWS, "m": M, "weights": ROWS * np.nan}, "weights must be finite"),
        ({"rows": ROWS, "m": M, "weights": -ROWS - 1.0}, "weights must be finite, at least 0"),
    ],
    ids=[
        "no rows",
        "no m",
        "half rows",
        "flat rows",
        "no columns",
        "two m",
        "negative m",
        "rows too large",
        "rows too small",
        "rows of points without coordinates",
        "other m than labels",
        "no weights",
        "weights not finite",
        "weights below 0",
    ],
)
def test_bad_map_gets_one_line(arrays, said, tmp_path):
    path = tmp_path / "map.npz"
    np.savez(path, **arrays)

    with pytest.raises(UserError, match=said) as error:
        propagate(np.arange(3), path)

    assert "\n" not in str(error.value)


def test_missing_map_gets_one_line(tmp_path):
    with pytest.raises(UserError, match=r"no file .*map.npz\. Write it by downsample --map"):
        propagate(np.arange(3), tmp_path / "map.npz")


def test_broken_map_gets_one_line(tmp_path):
    path = tmp_path / "map.npz"
    path.write_bytes(b"PK" * 40)

    with pytest.raises(UserError, match=r"map.npz is broken"):
        propagate(np.arange(3), path)


def test_dictionary_as_a_map_gets_one_line():
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
        ({"sampled_batch": [0] * 4}, "batch and sampled_batch belong together"),
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


@pytest.mark.parametrize("k", [1, 2, 5])
def test_map_breaks_ties_by_the_lowest_row(k):
    axis = np.arange(6.0)
    x, y, z = np.meshgrid(axis, axis, axis)
    grid = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    third = grid[::3]
    twice = np.concatenate([third, third])
    sampled = twice[::-1].copy()
    middles = grid + 0.5

    rows = propagation_map(middles, sampled, k).rows.numpy()

    squared = np.square(middles[:, None] - sampled).sum(2)
    nearest = squared.argsort(1, kind="stable")[:, :k]
    np.testing.assert_array_equal(rows, nearest)


def exact_mean(values, weights):
    """Round a weighted mean of whole numbers, computed in fractions."""
    total = Fraction(0)
    total_weight = Fraction(0)
    for value, weight in zip(values, weights, strict=True):
        total += int(value) * Fraction(weight)
        total_weight += Fraction(weight)
    return round(total / total_weight)


@pytest.mark.parametrize("kind", [np.int64, np.uint64])
def test_mean_of_64_bits_does_not_wrap(kind):
    largest = np.iinfo(kind).max
    smallest = np.iinfo(kind).min
    values = np.array([largest, largest - 1, smallest, smallest + 2, 2**60 + 1], kind)
    first_row = torch.tensor([0, 1, 2, 0, 3, 4])
    second_row = torch.tensor([1, 0, 3, 2, 1, 0])
    first_weight = torch.tensor([0.5, 0.75, 0.5, 0.5, 0.25, 1.0])
    rows = torch.stack([first_row, second_row], dim=1)
    weights = torch.stack([first_weight, 1 - first_weight], dim=1)
    made = PropagationMap(rows, weights, 5)

    means = propagate(values, made, mean=True)

    assert means.dtype == kind
    for row, weight, mean in zip(rows.numpy(), weights.tolist(), means, strict=True):
        averaged = values[row]
        expected = exact_mean(averaged, weight)
        assert abs(int(mean) - expected) <= 2**10  # float64 has 53 bits of the difference
        assert min(averaged) <= mean <= max(averaged)


@pytest.mark.parametrize("kind", [np.uint16, np.uint32, np.uint64, np.int64, np.float32])
@pytest.mark.parametrize("k", [1, 2])
def test_fill_is_the_value_of_points_without_coordinates(kind, k):
    largest = 9
    if kind is not np.float32:
        largest = np.iinfo(kind).max
    values = np.array([5, 6, largest], kind)
    rows = torch.tensor([[0, 1], [-1, -1], [2, 1]])
    weights = torch.full((3, k), 1 / k)
    made = PropagationMap(rows[:, :k], weights, 3)

    carried = propagate(values, made, fill=7)

    assert carried.dtype == kind
    assert carried[1] == 7
    if k == 1:
        assert carried.tolist() == [5, 7, largest]


def test_fill_that_the_type_cannot_hold_is_refused():
    rows = torch.tensor([[0], [-1]])
    made = PropagationMap(rows, torch.ones(2, 1), 1)
    values = np.array([5], np.uint16)

    with pytest.raises(UserError, match=r"fill must be a number of the type torch.uint16, got -1"):
        propagate(values, made, fill=-1)


def test_map_file_with_big_endian_arrays_is_read(tmp_path):
    path = tmp_path / "map.npz"
    rows = np.array([[1], [0]], ">i4")
    m = np.array(2, ">i8")
    np.savez(path, rows=rows, m=m)

    carried = propagate(np.array([7, 8]), path)

    assert carried.tolist() == [8, 7]


@pytest.mark.parametrize("name", ["rows", "weights", "m"])
@pytest.mark.parametrize("kind", ["c16", "M8[s]", "U3"])
def test_map_file_with_arrays_that_are_no_numbers_is_refused(kind, name, tmp_path):
    path = tmp_path / "map.npz"
    arrays = {
        "rows": np.zeros((2, 2), int),
        "weights": np.ones((2, 2), int),
        "m": np.array(2),
    }
    arrays[name] = arrays[name].astype(kind)
    np.savez(path, allow_pickle=True, **arrays)

    with pytest.raises(UserError, match=r"is no map|weights must be finite"):
        propagate(np.array([7, 8]), path)


def test_map_file_with_whole_numbers_as_weights_is_read(tmp_path):
    path = tmp_path / "map.npz"
    rows = np.array([[0, 1], [1, 2]])
    np.savez(path, rows=rows, m=np.array(3), weights=np.array([[1, 0], [0, 1]]))

    carried = propagate(np.array([0.5, 1.5, 2.5]), path)

    assert carried.tolist() == [0.5, 2.5]
