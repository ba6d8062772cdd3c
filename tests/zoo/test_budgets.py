"""``downsample`` to numbers, shares, spacings and voxels, of one and of many clouds."""

from typing import Any

import numpy as np
import pytest
import torch

from mops_lightning import FPSSampler, downsample
from mops_lightning.errors import UserError
from mops_lightning.ops.points import UnitSphere
from mops_lightning.ops.spacing import keep_spaced
from mops_lightning.samplers.poisson import poisson_rows

CLOUD = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) * 7


@pytest.mark.parametrize(
    ("m", "number"),
    [
        (20, 20),
        (1, 1),
        (np.int64(20), 20),
        (np.uint8(20), 20),
        (np.array(20), 20),
        (torch.tensor(20), 20),
        (0.1, 20),
        (np.float32(0.1), 20),
        (0.0001, 1),
        (0.0125, 3),
    ],
)
def test_m_is_a_number_or_a_share(m, number):
    points, rows = downsample(CLOUD, m)

    assert torch.equal(rows, downsample(CLOUD, number)[1])
    assert torch.equal(points, CLOUD[rows])


@pytest.mark.parametrize(
    "m", [True, np.True_, 0, -1, 1.0, 1.5, 0.0, -0.1, float("nan"), "5", torch.tensor(True)]
)
def test_m_of_another_kind_is_refused(m):
    with pytest.raises(UserError, match="m must be a whole number of at least 1, or a share"):
        downsample(CLOUD, m)


@pytest.mark.parametrize("m", [1.0, np.float32(1), torch.tensor(1.0)])
def test_share_of_one_is_refused_with_what_it_could_mean(m):
    with pytest.raises(UserError, match=r"One point is m=1, all points need no sampling\."):
        downsample(CLOUD, m)


@pytest.mark.parametrize("name", ["spacing", "voxel"])
@pytest.mark.parametrize("size", [True, 0.0, -1.0, float("inf"), float("nan"), "1"])
def test_distance_that_is_no_number_above_0_is_refused(name, size):
    budget: dict[str, Any] = {name: size}

    with pytest.raises(UserError, match=f"^{name} must be a number above 0, .* got {size}"):
        downsample(CLOUD, **budget)


@pytest.mark.parametrize("arguments", [{}, {"m": 5, "spacing": 1.0}, {"spacing": 1, "voxel": 1}])
def test_not_one_budget_is_refused(arguments):
    with pytest.raises(UserError, match="give m, spacing or voxel, got"):
        downsample(CLOUD, **arguments)


def test_spacing_of_a_tensor():
    points, rows = downsample(CLOUD, spacing=1.5)

    assert torch.equal(points, CLOUD[rows])
    distances = torch.cdist(CLOUD.double(), points.double())
    assert distances.amin(1).max() < 1.5
    assert distances[rows].fill_diagonal_(9.0).min() >= 1.5


def test_spacing_prefers_weights_and_leaves_zeros_out():
    weight = torch.ones(200)
    weight[7] = 5.0
    weight[:5] = 0.0

    _, rows = downsample(CLOUD, spacing=1.5, weight=weight)

    assert 7 in rows.tolist()
    assert min(rows.tolist()) >= 5


def test_voxel_keeps_one_point_of_each():
    points, rows = downsample(CLOUD.numpy(), voxel=2.0)

    assert isinstance(points, np.ndarray)
    assert np.array_equal(points, CLOUD.numpy()[rows])
    places = np.unique(np.floor(CLOUD.numpy().astype(np.float64) / 2.0), axis=0)
    assert len(points) == len(places)


def test_voxel_with_weights_keeps_the_heaviest_point_of_each():
    points = np.array(
        [
            [0.1, 0.5, 0.5],
            [0.5, 0.5, 0.5],
            [0.9, 0.5, 0.5],
            [1.5, 0.5, 0.5],
        ]
    )
    unequal = np.array([3.0, 1.0, 5.0, 1.0])
    equal = np.array([1.0, 1.0, 1.0, 1.0])

    _, heaviest = downsample(points, voxel=1.0, weight=unequal)
    _, nearest = downsample(points, voxel=1.0, weight=equal)

    assert heaviest.tolist() == [2, 3]
    assert nearest.tolist() == [1, 3]


def test_spacing_of_equal_weights_follows_the_seed_as_without_weights():
    weight = torch.ones(200)

    _, weighted = downsample(CLOUD, spacing=2.0, seed=0, weight=weight)
    _, weighted_by_other_seed = downsample(CLOUD, spacing=2.0, seed=7, weight=weight)

    _, plain = downsample(CLOUD, spacing=2.0, seed=0)
    _, plain_by_other_seed = downsample(CLOUD, spacing=2.0, seed=7)
    assert weighted.tolist() == plain.tolist()
    assert weighted_by_other_seed.tolist() == plain_by_other_seed.tolist()
    assert plain.tolist() != plain_by_other_seed.tolist()


def test_voxel_generated_returns_means_of_all_columns():
    points = np.array(
        [
            [0.1, 0.1, 0.1, 4.0],
            [0.3, 0.5, 0.9, 6.0],
            [1.5, 0.5, 0.5, 1.0],
        ]
    )

    means, rows = downsample(points, voxel=1.0, readout="generated")

    expected = [
        [0.2, 0.3, 0.5, 5.0],
        [1.5, 0.5, 0.5, 1.0],
    ]
    assert rows is None
    np.testing.assert_allclose(means, expected, atol=1e-10)


@pytest.mark.parametrize(
    "budget",
    [
        {"m": 10},
        {"spacing": 2.0},
        {"voxel": 3.0},
        {"m": 10, "tile": 50},
    ],
)
def test_further_columns_stay_with_their_points(budget):
    row = np.arange(200.0)
    points = np.column_stack([CLOUD.numpy(), row])

    kept, rows = downsample(points, **budget)

    assert np.array_equal(kept, points[rows])
    assert np.array_equal(kept[:, 3], rows)


def test_whole_number_coordinates_are_kept():
    points = np.arange(150).reshape(50, 3)

    kept, rows = downsample(points, 5)

    assert kept.dtype == points.dtype
    assert np.array_equal(kept, points[rows])
    assert len(set(rows.tolist())) == 5


def test_further_columns_do_not_change_the_choice():
    coordinates = CLOUD.numpy()
    points = np.column_stack([coordinates, np.arange(200.0)])

    _, rows = downsample(points, 10)
    _, rows_of_coordinates = downsample(coordinates, 10)

    assert np.array_equal(rows, rows_of_coordinates)


def test_list_of_clouds_of_several_sizes():
    medium = CLOUD[:50]
    large = CLOUD[:120].numpy()
    small = CLOUD[:4]

    points, rows = downsample([medium, large, small], 10)

    of_medium, of_large, of_small = points
    assert len(of_medium) == 10
    assert len(of_large) == 10
    assert len(of_small) == 4
    _, rows_alone = downsample(medium, 10)
    assert torch.equal(rows[0], rows_alone)
    assert isinstance(of_large, np.ndarray)
    assert rows[2].tolist() == [0, 1, 2, 3]


def test_another_m_per_cloud():
    clouds = CLOUD.view(2, 100, 3)
    batch = torch.arange(200) // 100

    _, (first, second) = downsample(clouds, [5, 0.2])
    flat_points, flat_rows = downsample(CLOUD, [5, 0.2], batch=batch)

    assert len(first) == 5
    assert len(second) == 20
    assert flat_rows.tolist() == [*first.tolist(), *(second + 100).tolist()]
    assert torch.equal(flat_points, CLOUD[flat_rows])


def test_share_of_each_cloud_of_a_batch():
    batch = torch.tensor([0] * 50 + [1] * 150)

    _, rows = downsample(CLOUD, 0.1, batch=batch)

    assert (rows < 50).sum() == 5
    assert (rows >= 50).sum() == 15


def test_spacing_and_voxel_of_a_batch_are_lists():
    batch = CLOUD.view(2, 100, 3)

    budgets: list[Any] = [{"spacing": 2.0}, {"voxel": 2.0}]
    for budget in budgets:
        points, rows = downsample(batch, **budget)
        assert torch.equal(rows[1], downsample(batch[1], **budget)[1])
        assert torch.equal(points[1], batch[1][rows[1]])


def test_space_makes_columns_count():
    points = np.column_stack([CLOUD.numpy(), np.zeros(200)])
    points[17, 3] = 100.0

    _, with_column = downsample(points, 2, start=0, space=(1, 1, 1, 1))
    _, without_column = downsample(points, 2, start=0, space=(1, 1, 1, 0))

    assert 17 in with_column
    assert 17 not in without_column


def test_space_scales_coordinates_for_a_spacing():
    coordinates = CLOUD.numpy()
    points = np.column_stack([coordinates, np.zeros(200)])

    _, rows = downsample(points, spacing=2.0, space=(1, 1, 2, 0))

    scaled = coordinates.astype(np.float64) * [1, 1, 2]
    assert rows.tolist() == keep_spaced(scaled, 2.0).tolist()


def test_space_of_poisson_scales_the_columns():
    coordinates = CLOUD.numpy()
    points = np.column_stack([coordinates, coordinates[:, 0] ** 2])

    _, rows = downsample(points, 40, "poisson", space=(1, 1, 2, 3))

    scaled = (points * [1, 1, 2, 3]).astype(np.float64)
    sphere = UnitSphere.around(scaled).normalise(scaled)
    (expected,) = poisson_rows(sphere[None], 40)
    _, rows_of_coordinates = downsample(points, 40, "poisson")
    assert rows.tolist() == expected.tolist()
    assert rows.tolist() != rows_of_coordinates.tolist()


def test_tile_keeps_m_points():
    _, rows = downsample(CLOUD, 40, tile=64)

    assert len(set(rows.tolist())) == 40


def test_folder_without_weights_is_refused(tmp_path):
    with pytest.raises(UserError, match="holds no weights"):
        downsample(CLOUD, 5, tmp_path)


def test_points_that_are_not_finite_are_refused():
    points = CLOUD.clone()
    points[3, 1] = torch.nan

    with pytest.raises(UserError, match="points must be finite"):
        downsample(points, spacing=1.0)


def test_voxel_rows_are_ascending():
    _, rows = downsample(CLOUD, voxel=2.0)
    _, weighted = downsample(CLOUD, voxel=2.0, weight=torch.ones(200))

    assert rows.tolist() == sorted(rows.tolist())
    assert weighted.tolist() == rows.tolist()


def test_voxel_means_have_the_type_of_the_points():
    single, _ = downsample(CLOUD, voxel=2.0, readout="generated")
    whole, _ = downsample(torch.arange(12).view(4, 3), voxel=6.0, readout="generated")

    assert single.dtype == torch.float32
    assert whole.dtype == torch.float64
    expected = [[1.5, 2.5, 3.5], [7.5, 8.5, 9.5]]
    np.testing.assert_allclose(whole, expected, atol=1e-9)


def test_curvature_as_weight_is_that_of_the_coordinates():
    coordinates = CLOUD.numpy()
    points = np.column_stack([coordinates, np.arange(200.0) ** 2])

    _, rows = downsample(points, spacing=1.5, weight="curvature")

    _, expected = downsample(coordinates, spacing=1.5, weight="curvature")
    assert rows.tolist() == expected.tolist()


def test_weights_of_a_flat_batch_belong_to_its_points():
    weight = torch.ones(200)
    weight[[7, 130]] = 5.0
    weight[:5] = 0.0
    batch = torch.tensor([0] * 50 + [1] * 150)

    _, rows = downsample(CLOUD, spacing=2.0, batch=batch, weight=weight)

    _, of_first = downsample(CLOUD[:50], spacing=2.0, weight=weight[:50])
    _, of_second = downsample(CLOUD[50:], spacing=2.0, weight=weight[50:])
    assert rows.tolist() == [*of_first.tolist(), *(of_second + 50).tolist()]
    assert {7, 130} <= set(rows.tolist())


def test_space_starts_where_it_is_told_or_by_the_seed():
    space = (1, 1, 0)

    _, from_row = downsample(CLOUD, 5, start=42, space=space)
    _, first = downsample(CLOUD, 5, seed=0, space=space)
    _, second = downsample(CLOUD, 5, seed=3, space=space)
    _, default = downsample(CLOUD, 5, space=space)

    assert from_row[0] == 42
    assert first.tolist() != second.tolist()
    assert default.tolist() == first.tolist()


def test_space_with_weights_leaves_zeros_out():
    weight = torch.ones(200)
    weight[:150] = 0.0

    _, rows = downsample(CLOUD, 10, space=(1, 1, 0), weight=weight)

    _, expected = downsample(CLOUD[150:], 10, space=(1, 1, 0))
    assert rows.tolist() == (expected + 150).tolist()


@pytest.mark.parametrize("seed", [0, 3])
def test_farthest_points_start_by_the_seed_of_the_sampler(seed):
    _, rows = downsample(CLOUD, 6, seed=seed)
    _, of_array = downsample(CLOUD.numpy(), 6, seed=seed)

    _, expected = FPSSampler(6, seed=seed).downsample(CLOUD)
    assert rows.tolist() == expected.tolist()
    assert of_array.tolist() == expected.tolist()
