from collections import defaultdict

import pytest
import torch

from mops_lightning.samplers.voxel import BISECTIONS, COARSEST, FINEST, VoxelSampler, fullest_voxels


def plain_voxels(cloud, level):
    """Return the points of every voxel, with 2^level voxels along the longest side."""
    axes = list(zip(*cloud, strict=True))
    low = [min(axis) for axis in axes]
    side = max(max(axis) - min(axis) for axis in axes)
    voxels = defaultdict(list)
    for row, point in enumerate(cloud):
        cell = []
        for coordinate, least in zip(point, low, strict=True):
            cell.append(int((coordinate - least) / side * 2**level))
        voxels[tuple(cell)].append(row)
    return voxels


def plain_choice(cloud, m):
    coarse, fine = COARSEST, FINEST
    for _ in range(BISECTIONS):
        middle = (coarse + fine) / 2
        if len(plain_voxels(cloud, middle)) >= m:
            fine = middle
        else:
            coarse = middle
    voxels = plain_voxels(cloud, fine)
    assert len(voxels) >= m > len(plain_voxels(cloud, coarse))
    ranked = sorted(voxels, key=lambda cell: (-len(voxels[cell]), cell))
    return [voxels[cell] for cell in ranked[:m]]


def assert_nearest_to_mean(row, cloud, voxel, tolerance=0.0):
    """Assert that a row is a point of a voxel, and the nearest to the mean of its points."""
    points = cloud[voxel]
    distances = (points - points.mean(0)).norm(dim=1)
    assert row in voxel
    distance = distances[voxel.index(row)]
    assert distance <= distances.min() * (1 + 1e-6) + tolerance


@pytest.mark.parametrize("m", [2, 13, 60])
def test_voxel_equals_plain_search(m, randn):
    points = randn(3, 100, 3, dtype=torch.float64)

    picked = VoxelSampler(m)(points)

    for cloud, rows in zip(points, picked.indices.tolist(), strict=True):
        voxels = plain_choice(cloud.tolist(), m)
        for slot, voxel in enumerate(voxels):
            assert_nearest_to_mean(rows[slot], cloud, voxel)


@pytest.mark.parametrize("name", ["clusters", "grid", "map"])
def test_fullest_voxels_equal_plain_search(name, randn, rand):
    """Most positions settle in their voxels long before the last step."""
    points = randn(1, 900, 3, dtype=torch.float64)
    spread = rand(1, 900, 1, dtype=torch.float64) ** 4
    size = torch.tensor([90.0, 40.0, 3.0])
    origin = torch.tensor([637e3, 851e3, 412.0])
    clouds = {
        "clusters": points * spread,
        "grid": (points * 8).round() / 8,  # positions on the faces of voxels, and copies
        "map": points * size + origin,
    }
    cloud = clouds[name]

    rows = fullest_voxels(cloud, 300)[0].tolist()

    voxels = plain_choice(cloud[0].tolist(), 300)
    assert len(rows) >= 300
    for row, voxel in zip(rows, voxels, strict=False):
        assert_nearest_to_mean(row, cloud[0], voxel, tolerance=1e-9)


def test_voxel_single_voxel_holds_all_points(randn):
    points = randn(2, 40, 3)
    nearest = (points - points.mean(1, keepdim=True)).norm(dim=2).argmin(1)
    assert VoxelSampler(1)(points).indices.squeeze(1).tolist() == nearest.tolist()


def test_fullest_voxels_outlier_leaves_enough_voxels(rand):
    """All points but one are within a thousandth of the bounding box's side."""
    points = 1e-3 * rand(1, 60, 3)
    points[0, 0] = 1.0

    rows = fullest_voxels(points, 20)[0].tolist()

    assert len(rows) >= 20
    assert len(set(rows)) == len(rows)


def test_voxel_fills_up_coincident_points():
    places = torch.tensor(
        [
            [0.0, 0.0, 0.0],
            [1.0, 0.0, 0.0],
            [0.0, 1.0, 0.0],
        ]
    )
    points = places.repeat_interleave(torch.tensor([5, 4, 3]), 0)

    output = VoxelSampler(7)(points[None])

    (sampled,) = output.points
    assert torch.equal(sampled[:3], places)  # in order of decreasing population
    assert torch.equal(sampled.unique(dim=0), places.unique(dim=0))
    assert len(output.indices.unique()) == 7


def test_voxel_fills_up_with_the_same_coordinates_in_any_order_of_the_input():
    """Which place is filled up by a copy is a tie, that the seeded order of coordinates breaks."""
    places = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    points = places.repeat_interleave(torch.tensor([5, 4, 3, 2]), 0)

    fills = []
    for seed in range(6):
        order = torch.randperm(14, generator=torch.Generator().manual_seed(seed))
        (sampled,) = VoxelSampler(6)(points[order][None]).points
        assert torch.equal(sampled[:4], places)
        fills.append(sampled[4:].tolist())

    assert fills == fills[:1] * 6
