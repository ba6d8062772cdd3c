from collections import defaultdict

import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.samplers.voxel import COARSEST, FINEST, HALVINGS, VoxelSampler, group_voxels


def plain_voxels(cloud, level):
    """Which points lie in which voxel, cut 2^level times along the longest side."""
    low = [min(p[k] for p in cloud) for k in range(3)]
    side = max(max(p[k] for p in cloud) - low[k] for k in range(3))
    voxels = defaultdict(list)
    for index, p in enumerate(cloud):
        voxels[tuple(int((p[k] - low[k]) / side * 2**level) for k in range(3))].append(index)
    return voxels


def plain_choice(cloud, m):
    coarse, fine = COARSEST, FINEST
    for _ in range(HALVINGS):
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
def test_equals_the_plain_search(m, rng):
    points = torch.randn(3, 100, 3, dtype=torch.float64, generator=rng)
    picked = VoxelSampler(m)(points)
    means = VoxelSampler(m, pick="centroid")(points)
    assert means.indices is None
    for b in range(3):
        members = plain_choice(points[b].tolist(), m)
        for slot, voxel in enumerate(members):
            mean = points[b][voxel].mean(0)
            torch.testing.assert_close(means.points[b, slot], mean)
            index = int(picked.indices[b, slot])
            distances = (points[b][voxel] - mean).norm(dim=1)
            assert index in voxel
            assert distances[voxel.index(index)] <= distances.min() * (1 + 1e-6)


def test_one_voxel_holds_everything(rng):
    points = torch.randn(2, 40, 3, generator=rng)
    centroid = VoxelSampler(1, pick="centroid")(points).points
    torch.testing.assert_close(centroid, points.mean(1, keepdim=True))
    nearest = (points - centroid).norm(dim=2).argmin(1)
    assert VoxelSampler(1)(points).indices.squeeze(1).tolist() == nearest.tolist()


def test_outliers_do_not_cost_the_others_their_voxels(rng):
    """All points but one lie in a thousandth of the bounding box's side."""
    points = 1e-3 * torch.rand(1, 60, 3, generator=rng)
    points[0, 0] = 1.0
    voxels = group_voxels(points, 20)
    assert (voxels.population > 0).sum() >= 20
    assert voxels.population.sum() == 60


@pytest.mark.parametrize("pick", ["nearest", "centroid"])
def test_filled_by_farthest_points_where_too_few_places_exist(pick):
    places = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [0.0, 1.0, 0]])
    points = places.repeat_interleave(torch.tensor([5, 4, 3]), 0)[None]
    output = VoxelSampler(7, pick=pick)(points)
    assert output.points[0, :3].tolist() == places.tolist()  # by falling population
    rows = {tuple(p) for p in output.points[0].tolist()}
    assert rows == {tuple(p) for p in places.tolist()}
    if pick == "nearest":
        assert len(set(output.indices[0].tolist())) == 7


def test_centroid_passes_gradients_to_all_points_of_the_voxel(rng):
    points = torch.randn(1, 30, 3, dtype=torch.float64, generator=rng, requires_grad=True)
    VoxelSampler(1, pick="centroid")(points).points.sum().backward()
    torch.testing.assert_close(points.grad, torch.full_like(points, 1 / 30))


def test_unknown_pick_gets_the_nearest_known_one():
    with pytest.raises(UserError, match="Did you mean 'centroid'"):
        VoxelSampler(4, pick="centriod")  # type: ignore[arg-type]
