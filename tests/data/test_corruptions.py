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
    points = torch.randn(4, N, 3, generator=torch.Generator().manual_seed(3))
    points = points - points.mean(1, keepdim=True)
    return Clouds(points / points.norm(dim=2).amax(1)[:, None, None], torch.arange(4))


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
    once = corrupt(clouds, f"{kind}-3")
    assert torch.equal(corrupt(clouds, f"{kind}-3").points, once.points)
    first = corrupt(clouds.take(torch.tensor([0, 1])), f"{kind}-3").points
    assert torch.equal(first, once.points[:2])
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
    few, many = (corrupt(clouds, f"{kind}-{severity}").points for severity in (1, 5))
    assert torch.equal(many[:, :N], clouds.points)
    assert N < few.shape[1] < many.shape[1]


def test_jitter_has_the_standard_deviation(clouds):
    noise = corrupt(clouds, "jitter-5").points - clouds.points
    assert noise.std().item() == pytest.approx(0.05, rel=0.05)


def test_rotation_turns_by_at_most_its_angle(clouds):
    turned = corrupt(clouds, "rotation-2").points
    for cloud, other in zip(clouds.points, turned, strict=True):
        turn = torch.linalg.lstsq(cloud, other).solution
        assert torch.allclose(turn @ turn.T, torch.eye(3), atol=1e-4)
        assert torch.linalg.det(turn) > 0
        assert 1 < math.degrees(math.acos((turn.trace() - 1) / 2)) <= 30


def test_scaling_and_shear_are_linear_maps(clouds):
    for kind, off_diagonal in (("scaling", 0.0), ("shear", 0.25)):
        for cloud, other in zip(clouds.points, corrupt(clouds, f"{kind}-5").points, strict=True):
            centred = cloud - cloud.mean(0)
            mixed = torch.linalg.lstsq(centred, other - other.mean(0)).solution
            assert torch.allclose(centred @ mixed, other - other.mean(0), atol=1e-4)
            relative = mixed / mixed.diagonal().mean()
            rest = relative - relative.diagonal().diag()
            assert rest.abs().max() <= max(off_diagonal, 1e-3)
            ratio = mixed.diagonal().max() / mixed.diagonal().min()
            assert ratio <= (4.01 if kind == "scaling" else 1.001)
            assert other.norm(dim=1).max().item() == pytest.approx(1, abs=1e-5)


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
    for s in range(4):
        inside = neighbourhoods(clouds.points[s], N // 10)
        down, up = (removed(clouds, f"{kind}-1", s) for kind in ("density_down", "density_up"))
        assert (~inside & down).sum(1).min() == 0
        assert (inside & up).sum(1).min() == 0
        assert down.sum() == up.sum() == round(0.75 * (N // 10))


def test_local_drop_is_closer_together_than_global_drop(clouds):
    def spread(kind):
        groups = [clouds.points[s][removed(clouds, kind, s)] for s in range(4)]
        return sum(torch.cdist(group, group).mean() for group in groups)

    assert spread("drop_local-1") < 0.9 * spread("drop_global-1")


def test_added_points_are_where_they_should_be(clouds):
    ball, local, cube = (
        corrupt(clouds, f"{kind}-5").points[:, N:]
        for kind in ("add_global", "add_local", "background")
    )
    assert ball.norm(dim=2).max() <= 1
    assert ball.norm(dim=2).pow(3).mean().item() == pytest.approx(0.5, abs=0.1)
    assert cube.abs().max() <= 1
    assert cube.norm(dim=2).max() > 1
    distance = torch.cdist(local, clouds.points)
    assert distance.amin(2).mean() < 0.2


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
    [Channel("intensity"), Channel("normal_x"), Channel("normal_y"), Channel("normal_z")]
)


def with_channels(clouds):
    """Points of spheres with their rows as intensity, and their normals."""
    places = torch.nn.functional.normalize(clouds.points, dim=2)
    rows = torch.arange(N).expand(4, N)[..., None].float()
    return clouds._replace(points=torch.cat([places, rows, places], 2))


@pytest.mark.parametrize("kind", KINDS)
def test_coordinates_are_corrupted_as_without_channels(clouds, kind):
    given = with_channels(clouds)
    bare = given._replace(points=given.points[..., :3].contiguous())

    corrupted = corrupt(given, f"{kind}-3", NORMALS).points

    torch.testing.assert_close(corrupted[..., :3], corrupt(bare, f"{kind}-3").points)


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

    for cloud, before in zip(corrupted, given.points, strict=True):
        assert torch.equal(cloud[:N], before)
        assert torch.equal(cloud[N:, 4:], before[cloud[N:, 3].long(), 4:])


def test_rotation_turns_normals(clouds):
    corrupted = corrupt(with_channels(clouds), "rotation-5", NORMALS).points

    torch.testing.assert_close(corrupted[..., 4:], corrupted[..., :3], atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("kind", ["scaling", "shear"])
def test_linear_map_keeps_normals_normal_to_the_surface(clouds, kind):
    given = with_channels(clouds)

    corrupted = corrupt(given, f"{kind}-5", NORMALS).points

    # Tangents of the sphere, mapped as differences of points, stay orthogonal to the normals.
    for before, after in zip(given.points, corrupted, strict=True):
        affine = torch.linalg.lstsq(
            torch.cat([before[:, :3], torch.ones(N, 1)], 1), after[:, :3]
        ).solution
        tangents = torch.linalg.cross(before[:, :3], torch.tensor([0.3, 0.5, 0.8]).expand(N, 3))
        mapped = tangents @ affine[:3]
        assert (mapped * after[:, 4:]).sum(1).abs().max() < 1e-4
        torch.testing.assert_close(after[:, 4:].norm(dim=1), torch.ones(N))
