from collections import defaultdict

import pytest
import torch

from mops_lightning.samplers.voxel import BISECTIONS, COARSEST, FINEST, VoxelSampler, fullest_voxels


def plain_voxels(cloud, level):
    """Return the points of every voxel, with 2^level voxels along the longest side."""
    low = [min(p[k] for p in cloud) for k in range(3)]
    side = max(max(p[k] for p in cloud) - low[k] for k in range(3))
    voxels = defaultdict(list)
    for index, p in enumerate(cloud):
        voxels[tuple(int((p[k] - low[k]) / side * 2**level) for k in range(3))].append(index)
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


@pytest.mark.parametrize("m", [2, 13, 60])
def test_voxel_equals_plain_search(m, rng):
    points = torch.randn(3, 100, 3, dtype=torch.float64, generator=rng)
    picked = VoxelSampler(m)(points)
    for b in range(3):
        members = plain_choice(points[b].tolist(), m)
        for slot, voxel in enumerate(members):
            mean = points[b][voxel].mean(0)
            index = int(picked.indices[b, slot])
            distances = (points[b][voxel] - mean).norm(dim=1)
            assert index in voxel
            assert distances[voxel.index(index)] <= distances.min() * (1 + 1e-6)


@pytest.mark.parametrize("name", ["clusters", "grid", "map"])
def test_fullest_voxels_equal_plain_search(name, rng):
    """Most positions settle in their voxels long before the last step."""
    points = torch.randn(1, 900, 3, dtype=torch.float64, generator=rng)
    clouds = {
        "clusters": points * torch.rand(1, 900, 1, dtype=torch.float64, generator=rng) ** 4,
        "grid": (points * 8).round() / 8,  # positions on the faces of voxels, and copies
        "map": points * torch.tensor([90.0, 40.0, 3.0]) + torch.tensor([637e3, 851e3, 412.0]),
    }
    cloud = clouds[name]

    rows = fullest_voxels(cloud, 300)[0].tolist()

    members = plain_choice(cloud[0].tolist(), 300)
    assert len(rows) >= 300
    for row, voxel in zip(rows, members, strict=False):
        mean = cloud[0][voxel].mean(0)
        distances = (cloud[0][voxel] - mean).norm(dim=1)
        assert row in voxel
        assert distances[voxel.index(row)] <= distances.min() * (1 + 1e-6) + 1e-9


def test_voxel_single_voxel_holds_all_points(rng):
    points = torch.randn(2, 40, 3, generator=rng)
    nearest = (points - points.mean(1, keepdim=True)).norm(dim=2).argmin(1)
    assert VoxelSampler(1)(points).indices.squeeze(1).tolist() == nearest.tolist()


def test_fullest_voxels_outlier_leaves_enough_voxels(rng):
    """All points but one are within a thousandth of the bounding box's side."""
    points = 1e-3 * torch.rand(1, 60, 3, generator=rng)
    points[0, 0] = 1.0

    rows = fullest_voxels(points, 20)[0].tolist()

    assert len(rows) >= 20
    assert len(set(rows)) == len(rows)


def test_voxel_fills_up_coincident_points():
    places = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [0.0, 1.0, 0]])
    points = places.repeat_interleave(torch.tensor([5, 4, 3]), 0)[None]
    output = VoxelSampler(7)(points)
    assert output.points[0, :3].tolist() == places.tolist()  # in order of decreasing population
    rows = {tuple(p) for p in output.points[0].tolist()}
    assert rows == {tuple(p) for p in places.tolist()}
    assert len(set(output.indices[0].tolist())) == 7
