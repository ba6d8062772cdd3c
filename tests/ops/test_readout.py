import re

import pytest
import torch
from scipy.spatial import cKDTree

from mops_lightning.errors import UserError
from mops_lightning.ops.readout import complete, match, unique_count
from tests.support.plain import plain_farthest


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_match_equals_kd_tree(dtype, randn):
    points = randn(4, 700, 3, dtype=dtype)
    generated = 0.7 * randn(4, 90, 3, dtype=dtype)

    matched = match(generated, points)

    for cloud, sample, rows in zip(points, generated, matched, strict=True):
        _, expected = cKDTree(cloud.numpy()).query(sample.numpy())
        assert rows.tolist() == expected.tolist()


def test_match_has_no_gradients(randn):
    points = randn(1, 9, 3, requires_grad=True)
    assert not match(points, points).requires_grad


def test_unique_count_equals_sets(rng):
    indices = torch.randint(12, (6, 10), generator=rng)
    indices[0] = 5
    indices[1] = torch.arange(10)
    assert unique_count(indices).tolist() == [len(set(row)) for row in indices.tolist()]


def plain_complete(indices, cloud):
    chosen = list(dict.fromkeys(indices.tolist()))
    return plain_farthest(cloud, chosen, len(indices))


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
        chosen = list(dict.fromkeys(indices[cloud].tolist()))
        expected = plain_farthest(points[cloud], chosen, 20, weight[cloud])
        assert completed[cloud].tolist() == expected


def test_complete_of_coincident_points_is_distinct():
    indices = torch.tensor([[4, 4, 2, 4, 2, 0, 0, 0]])
    assert sorted(complete(indices, torch.ones(1, 8, 3))[0].tolist()) == list(range(8))


@pytest.mark.parametrize(
    ("indices", "points"),
    [
        (torch.zeros(1, 2), torch.zeros(1, 3, 3)),
        (torch.tensor([0, 1]), torch.zeros(1, 3, 3)),
        (torch.tensor([[0, 1]]), torch.zeros(3, 3)),
        (torch.zeros(1, 4).long(), torch.zeros(1, 3, 3)),
        (torch.tensor([[0, 1]]), torch.zeros(2, 3, 3)),
    ],
)
def test_complete_wrong_arguments_raise(indices, points):
    shapes = f"{indices.dtype} {tuple(indices.shape)} and {tuple(points.shape)}."
    with pytest.raises(UserError, match=rf"indices must be int64 .*got {re.escape(shapes)}"):
        complete(indices, points)


@pytest.mark.parametrize("shape", [(4, 3), (2, 4, 3), (1, 4, 2)])
def test_match_other_shapes_raise(shape):
    with pytest.raises(UserError, match=r"queries .* and points .* must agree"):
        match(torch.zeros(shape), torch.zeros(1, 5, 3))
