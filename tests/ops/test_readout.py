import pytest
import torch
from scipy.spatial import cKDTree

from mops_lightning.errors import UserError
from mops_lightning.ops.readout import complete, match, select, unique_count
from tests.support.plain import plain_farthest


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_match_equals_kd_tree(dtype, randn):
    points = randn(4, 700, 3, dtype=dtype)
    generated = 0.7 * randn(4, 90, 3, dtype=dtype)

    matched = match(generated, points)

    for cloud, sample, rows in zip(points, generated, matched, strict=True):
        _, expected = cKDTree(cloud).query(sample)
        assert rows.tolist() == expected.tolist()


def test_match_has_no_gradients(randn):
    points = randn(1, 9, 3, requires_grad=True)

    rows = match(points, points)

    assert not rows.requires_grad


def test_unique_count_equals_sets(rng):
    indices = torch.randint(12, (6, 10), generator=rng)
    indices[0] = 5
    indices[1] = torch.arange(10)

    counts = unique_count(indices)

    for row, count in zip(indices.tolist(), counts.tolist(), strict=True):
        assert count == len(set(row))


def plain_complete(indices, cloud, weight=None):
    without_copies = list(dict.fromkeys(indices.tolist()))
    return plain_farthest(cloud, without_copies, len(indices), weight)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_complete_equals_sequential_form(dtype, rng, randn):
    points = randn(6, 50, 3, dtype=dtype)
    indices = torch.randint(18, (6, 20), generator=rng)
    indices[0] = 7  # all matched to one point
    indices[1] = torch.randperm(50, generator=rng)[:20]  # nothing missing

    completed = complete(indices, points)

    assert completed.dtype == torch.int64
    assert torch.equal(completed[1], indices[1])
    for cloud, matched, rows in zip(points, indices, completed, strict=True):
        assert rows.tolist() == plain_complete(matched, cloud)


def test_complete_fills_up_by_weight(rng, randn, rand):
    points = randn(4, 50, 3, dtype=torch.float64)
    indices = torch.randint(8, (4, 20), generator=rng)
    weight = rand(4, 50)

    completed = complete(indices, points, weight)

    for cloud in range(4):
        expected = plain_complete(indices[cloud], points[cloud], weight[cloud])
        assert completed[cloud].tolist() == expected


def test_select_of_completed_sets_fills_up_by_weight(randn, rand):
    points = randn(4, 50, 3, dtype=torch.float64)
    generated = points[:, :1] + 0.01 * randn(4, 12, 3, dtype=torch.float64)  # few different matches
    weight = rand(4, 50)

    completed, rows = select(points, generated, "completed", weight)

    matched = match(generated, points)
    assert rows is not None
    for cloud in range(4):
        expected = plain_complete(matched[cloud], points[cloud], weight[cloud])
        unweighted = plain_complete(matched[cloud], points[cloud])
        assert rows[cloud].tolist() == expected
        assert rows[cloud].tolist() != unweighted
        assert torch.equal(completed[cloud], points[cloud][expected])


def test_complete_fills_up_by_coordinates_alone(rng, randn):
    points = randn(4, 50, 3)
    channels = 10 * randn(4, 50, 2)
    indices = torch.randint(8, (4, 20), generator=rng)

    completed = complete(indices, torch.cat([points, channels], 2))

    assert torch.equal(completed, complete(indices, points))


def test_complete_of_coincident_points_is_distinct():
    indices = torch.tensor([[4, 4, 2, 4, 2, 0, 0, 0]])
    points = torch.ones(1, 8, 3)

    (completed,) = complete(indices, points)

    assert sorted(completed.tolist()) == list(range(8))


@pytest.mark.parametrize(
    ("dtype", "shape_of_indices", "shape_of_points"),
    [
        (torch.float32, (1, 2), (1, 3, 3)),
        (torch.int64, (2,), (1, 3, 3)),
        (torch.int64, (1, 2), (3, 3)),
        (torch.int64, (1, 4), (1, 3, 3)),
        (torch.int64, (1, 2), (2, 3, 3)),
    ],
)
def test_complete_wrong_arguments_raise(dtype, shape_of_indices, shape_of_points):
    indices = torch.zeros(shape_of_indices, dtype=dtype)
    points = torch.zeros(shape_of_points)

    with pytest.raises(UserError, match=r"indices must be int64 .*got ") as caught:
        complete(indices, points)

    assert str(caught.value).endswith(f"{dtype} {shape_of_indices} and {shape_of_points}.")


@pytest.mark.parametrize("shape", [(4, 3), (2, 4, 3), (1, 4, 2)])
def test_match_other_shapes_raise(shape):
    generated = torch.zeros(shape)
    points = torch.zeros(1, 5, 3)

    with pytest.raises(UserError, match=r"queries .* and points .* must agree"):
        match(generated, points)
