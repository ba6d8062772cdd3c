"""Corruptions of test clouds, each against what its docstring says."""

import math

import pytest
import torch

from mops_lightning.channels import Channel, PointChannels
from mops_lightning.data.clouds import Clouds
from mops_lightning.data.corruptions import KINDS, corrupt
from mops_lightning.errors import UserError

N = 400
MOVED = ("jitter", "rotation", "scaling", "shear", "distortion")
SHRUNK = ("density_down", "density_up", "cutout", "drop_global", "drop_local")
GROWN = ("add_global", "add_local", "background")


@pytest.fixture(scope="module")
def clouds():
    rng = torch.Generator().manual_seed(3)
    points = torch.randn(4, N, 3, generator=rng)
    centred = points - points.mean(1, keepdim=True)
    radii = centred.norm(dim=2).amax(1)
    return Clouds(centred / radii[:, None, None], torch.arange(4))


def rows_in(part, whole):
    """Return the row in ``whole`` of each point of ``part``; fails if there is none."""
    equal = (part[:, None] == whole[None]).all(2)
    assert equal.any(1).all()
    return equal.int().argmax(1)


def removed(clouds, spec, s):
    kept = rows_in(corrupt(clouds, spec).points[s], clouds.points[s])
    gone = torch.ones(N, dtype=torch.bool)
    gone[kept] = False
    assert gone.sum() == N - len(kept)
    return gone


def neighbourhoods(cloud, size):
    """Return for every point, as a mask, its ``size`` nearest."""
    near = torch.cdist(cloud, cloud).argsort(1)[:, :size]
    return torch.zeros(N, N, dtype=torch.bool).scatter_(1, near, True)


def test_every_kind_is_tested():
    assert set(KINDS) == {*MOVED, *SHRUNK, *GROWN}


@pytest.mark.parametrize("kind", KINDS)
def test_draw_depends_on_the_position_of_the_cloud_only(clouds, kind):
    spec = f"{kind}-3"
    first_two = clouds.take(torch.tensor([0, 1]))

    once = corrupt(clouds, spec)
    again = corrupt(clouds, spec)
    of_first_two = corrupt(first_two, spec)

    assert torch.equal(again.points, once.points)
    assert torch.equal(of_first_two.points, once.points[:2])
    assert torch.equal(once.labels, clouds.labels)
    assert torch.isfinite(once.points).all()


@pytest.mark.parametrize("kind", MOVED)
def test_higher_severity_moves_points_farther(clouds, kind):
    moved = [
        (corrupt(clouds, f"{kind}-{severity}").points - clouds.points).norm(dim=2).mean().item()
        for severity in (1, 3, 5)
    ]
    assert 0 < moved[0] < moved[1] < moved[2]


@pytest.mark.parametrize("kind", SHRUNK)
def test_removal_keeps_a_subset_in_order(clouds, kind):
    counts = []
    for severity in range(1, 6):
        points = corrupt(clouds, f"{kind}-{severity}").points
        counts.append(points.shape[1])
        for s in range(len(points)):
            assert rows_in(points[s], clouds.points[s]).diff().min() > 0
    assert counts == sorted(counts, reverse=True)
    assert N > counts[0] > counts[4]


@pytest.mark.parametrize("kind", GROWN)
def test_addition_keeps_the_cloud_first(clouds, kind):
    few = corrupt(clouds, f"{kind}-1").points
    many = corrupt(clouds, f"{kind}-5").points

    assert torch.equal(many[:, :N], clouds.points)
    assert N < few.shape[1] < many.shape[1]


def test_jitter_has_the_standard_deviation(clouds):
    noise = corrupt(clouds, "jitter-5").points - clouds.points
    assert noise.std().item() == pytest.approx(0.05, rel=0.05)


def linear_map(before, after):
    """Return the matrix ``(C, 3)`` that maps one set of points to another best."""
    return torch.linalg.lstsq(before, after).solution


def test_rotation_turns_by_at_most_its_angle(clouds):
    turned = corrupt(clouds, "rotation-2").points

    for before, after in zip(clouds.points, turned, strict=True):
        rotation = linear_map(before, after)
        assert torch.allclose(rotation @ rotation.T, torch.eye(3), atol=1e-4)
        assert torch.linalg.det(rotation) > 0
        cosine = (rotation.trace() - 1) / 2
        assert 1 < math.degrees(math.acos(cosine)) <= 30


@pytest.mark.parametrize(
    ("kind", "largest_off_diagonal", "largest_ratio"),
    [
        ("scaling", 1e-3, 4.01),
        ("shear", 0.25, 1.001),
    ],
)
def test_scaling_and_shear_are_linear_maps(clouds, kind, largest_off_diagonal, largest_ratio):
    mapped = corrupt(clouds, f"{kind}-5").points

    for before, after in zip(clouds.points, mapped, strict=True):
        centred = before - before.mean(0)
        centred_after = after - after.mean(0)
        matrix = linear_map(centred, centred_after)
        assert torch.allclose(centred @ matrix, centred_after, atol=1e-4)
        diagonal = matrix.diagonal()
        off_diagonal = (matrix - diagonal.diag()) / diagonal.mean()
        assert off_diagonal.abs().max() <= largest_off_diagonal
        assert diagonal.max() / diagonal.min() <= largest_ratio
        farthest = after.norm(dim=1).max().item()
        assert farthest == pytest.approx(1, abs=1e-5)


def test_distortion_moves_neighbours_alike(clouds):
    cloud = clouds.points[0]
    other = corrupt(clouds, "distortion-1").points[0]
    near = torch.cdist(cloud, cloud).fill_diagonal_(9).argmin(1)
    shift = other - cloud
    assert (shift - shift[near]).norm(dim=1).mean() < 0.5 * shift.std(0).norm()


def test_cutout_cuts_whole_neighbourhoods(clouds):
    hole = round(0.03 * N)
    for s in range(4):
        gone = removed(clouds, "cutout-1", s)
        inside = neighbourhoods(clouds.points[s], hole)
        # The first hole is the neighbourhood of a point; all of it is gone.
        assert (inside & ~gone).sum(1).min() == 0
        assert gone.sum() == 2 * hole


def test_density_changes_inside_or_outside_of_one_neighbourhood(clouds):
    size = N // 10
    for s in range(4):
        inside = neighbourhoods(clouds.points[s], size)

        down = removed(clouds, "density_down-1", s)
        up = removed(clouds, "density_up-1", s)

        removed_outside = (~inside & down).sum(1)
        removed_inside = (inside & up).sum(1)
        assert removed_outside.min() == 0
        assert removed_inside.min() == 0
        assert down.sum() == round(0.75 * size)
        assert up.sum() == round(0.75 * size)


def test_local_drop_is_closer_together_than_global_drop(clouds):
    def spread(kind):
        groups = [clouds.points[s][removed(clouds, kind, s)] for s in range(4)]
        return sum(torch.cdist(group, group).mean() for group in groups)

    assert spread("drop_local-1") < 0.9 * spread("drop_global-1")


def test_added_points_are_where_they_should_be(clouds):
    ball = corrupt(clouds, "add_global-5").points[:, N:]
    local = corrupt(clouds, "add_local-5").points[:, N:]
    cube = corrupt(clouds, "background-5").points[:, N:]

    radii = ball.norm(dim=2)
    assert radii.max() <= 1
    volumes = radii.pow(3)
    assert volumes.mean().item() == pytest.approx(0.5, abs=0.1)
    assert cube.abs().max() <= 1
    assert cube.norm(dim=2).max() > 1
    to_cloud = torch.cdist(local, clouds.points).amin(2)
    assert to_cloud.mean() < 0.2


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        ("sheer-3", "Did you mean 'shear'"),
        ("shear", "severity of 1 to 5.*got 'shear'"),
        ("shear-6", "got 'shear-6'"),
        ("shear-٣", "got"),
    ],
)
def test_unknown_kind_or_severity_is_refused(clouds, spec, said):
    with pytest.raises(UserError, match=rf"test_corruption must be a kind.*{said}"):
        corrupt(clouds, spec)


@pytest.mark.parametrize("kind", KINDS)
def test_parts_are_kept_where_points_were_only_moved(clouds, kind):
    parts = torch.arange(4 * N).view(4, N)

    corrupted = corrupt(clouds._replace(parts=parts), f"{kind}-3")

    if kind in MOVED:
        assert corrupted.parts is not None
        assert torch.equal(corrupted.parts, parts)
    else:
        assert corrupted.parts is None


NORMALS = PointChannels(
    [
        Channel("intensity"),
        Channel("normal_x"),
        Channel("normal_y"),
        Channel("normal_z"),
    ]
)


def with_channels(clouds):
    """Points of spheres with their rows as intensity, and their normals."""
    normals = torch.nn.functional.normalize(clouds.points, dim=2)
    rows = torch.arange(N).expand(4, N)
    intensity = rows[..., None].float()
    return clouds._replace(points=torch.cat([normals, intensity, normals], 2))


@pytest.mark.parametrize("kind", KINDS)
def test_coordinates_are_corrupted_as_without_channels(clouds, kind):
    spec = f"{kind}-3"
    given = with_channels(clouds)
    coordinates = given.points[..., :3].contiguous()

    corrupted = corrupt(given, spec, NORMALS).points

    without_channels = corrupt(given._replace(points=coordinates), spec).points
    torch.testing.assert_close(corrupted[..., :3], without_channels)


@pytest.mark.parametrize("kind", SHRUNK)
def test_removal_keeps_the_channels_of_points(clouds, kind):
    given = with_channels(clouds)

    corrupted = corrupt(given, f"{kind}-3", NORMALS).points

    for cloud, before in zip(corrupted, given.points, strict=True):
        assert torch.equal(cloud, before[cloud[:, 3].long()])


@pytest.mark.parametrize("kind", GROWN)
def test_added_points_have_the_channels_of_points_of_the_cloud(clouds, kind):
    given = with_channels(clouds)

    corrupted = corrupt(given, f"{kind}-3", NORMALS).points

    for after, before in zip(corrupted, given.points, strict=True):
        added = after[N:]
        rows = added[:, 3].long()
        normals = before[rows, 4:]
        assert torch.equal(after[:N], before)
        assert torch.equal(added[:, 4:], normals)


def test_rotation_turns_normals(clouds):
    corrupted = corrupt(with_channels(clouds), "rotation-5", NORMALS).points

    torch.testing.assert_close(corrupted[..., 4:], corrupted[..., :3], atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("kind", ["scaling", "shear"])
def test_linear_map_keeps_normals_normal_to_the_surface(clouds, kind):
    given = with_channels(clouds)

    corrupted = corrupt(given, f"{kind}-5", NORMALS).points

    # Tangents of the sphere, mapped as differences of points, stay orthogonal to the normals.
    direction = torch.tensor([0.3, 0.5, 0.8]).expand(N, 3)
    for before, after in zip(given.points, corrupted, strict=True):
        sphere = before[:, :3]
        homogeneous = torch.cat([sphere, torch.ones(N, 1)], 1)
        affine = linear_map(homogeneous, after[:, :3])
        tangents = torch.linalg.cross(sphere, direction)
        mapped = tangents @ affine[:3]
        normals = after[:, 4:]
        products = (mapped * normals).sum(1)
        assert products.abs().max() < 1e-4
        torch.testing.assert_close(normals.norm(dim=1), torch.ones(N))
