"""Corruptions of test clouds, each against what its docstring says."""

import math

import numpy as np
import pytest
import torch
from scipy.interpolate import interpn
from torch.testing import assert_close

from mops_lightning.channels import Channel, PointChannels
from mops_lightning.data.clouds import Clouds
from mops_lightning.data.corruptions import KINDS, _split, corrupt
from mops_lightning.errors import UserError
from mops_lightning.seeding import generator

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
    normalised = centred / radii[:, None, None]
    return Clouds(normalised, torch.arange(4))


def rows_in(part, whole):
    """Return the row in ``whole`` of each point of ``part``; fails if there is none."""
    same_coordinates = part[:, None] == whole[None]
    equal = same_coordinates.all(2)
    assert equal.any(1).all()
    return equal.int().argmax(1)


def removed(clouds, spec, s):
    left = corrupt(clouds, spec).points[s]
    kept = rows_in(left, clouds.points[s])
    gone = torch.ones(N, dtype=torch.bool)
    gone[kept] = False
    assert gone.sum() == N - len(kept)
    return gone


def neighbourhoods(cloud, size):
    """Return for every point, as a mask, its ``size`` nearest."""
    order = torch.cdist(cloud, cloud).argsort(1)
    near = order[:, :size]
    is_near = torch.zeros(N, N, dtype=torch.bool)
    return is_near.scatter_(1, near, True)


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
    moved = []
    for severity in (1, 3, 5):
        shift = corrupt(clouds, f"{kind}-{severity}").points - clouds.points
        distances = shift.norm(dim=2)
        moved.append(distances.mean().item())

    assert 0 < moved[0] < moved[1] < moved[2]


@pytest.mark.parametrize("kind", SHRUNK)
def test_removal_keeps_a_subset_in_order(clouds, kind):
    counts = []
    for severity in range(1, 6):
        points = corrupt(clouds, f"{kind}-{severity}").points
        counts.append(points.shape[1])
        for cloud, whole in zip(points, clouds.points, strict=True):
            rows = rows_in(cloud, whole)
            assert rows.diff().min() > 0
    assert counts == sorted(counts, reverse=True)
    assert N > counts[0] > counts[4]


@pytest.mark.parametrize("kind", GROWN)
def test_addition_keeps_the_cloud_first(clouds, kind):
    few = corrupt(clouds, f"{kind}-1").points
    many = corrupt(clouds, f"{kind}-5").points

    assert torch.equal(many[:, :N], clouds.points)
    assert N < few.shape[1] < many.shape[1]


SIZES = {
    "density_down": (370, 340, 310, 280, 250),
    "density_up": (370, 340, 310, 280, 250),
    "cutout": (376, 364, 340, 316, 280),
    "drop_global": (300, 250, 200, 150, 100),
    "drop_local": (360, 320, 280, 240, 200),
    "add_global": (404, 408, 412, 416, 420),
    "add_local": (440, 480, 520, 560, 600),
    "background": (409, 410, 411, 413, 420),
}
"""Points that are left of 400, or come out, at severities 1 to 5."""


@pytest.mark.parametrize("kind", SIZES)
def test_every_severity_has_its_number_of_points(clouds, kind):
    sizes = []
    for severity in range(1, 6):
        corrupted = corrupt(clouds, f"{kind}-{severity}")
        sizes.append(corrupted.points.shape[1])

    assert tuple(sizes) == SIZES[kind]


@pytest.mark.parametrize("severity", [1, 2, 3, 4, 5])
def test_jitter_has_the_standard_deviation(clouds, severity):
    noise = corrupt(clouds, f"jitter-{severity}").points - clouds.points

    spread = noise.std().item()
    assert spread == pytest.approx(0.01 * severity, rel=0.05)


def linear_map(before, after):
    """Return the matrix ``(C, 3)`` that maps one set of points to another best."""
    return torch.linalg.lstsq(before, after).solution


def test_rotation_turns_by_at_most_its_angle(clouds):
    turned = corrupt(clouds, "rotation-2").points

    for before, after in zip(clouds.points, turned, strict=True):
        rotation = linear_map(before, after)
        product = rotation @ rotation.T
        assert torch.allclose(product, torch.eye(3), atol=1e-4)
        assert torch.linalg.det(rotation) > 0
        cosine = (rotation.trace() - 1) / 2
        degrees = math.degrees(math.acos(cosine))
        assert 1 < degrees <= 30


def maps_of_many(kind, severity):
    """Return the linear maps ``(200, 3, 3)`` of 200 clouds, up to a factor for each of them."""
    rng = torch.Generator().manual_seed(1)
    points = torch.randn(200, 12, 3, generator=rng)
    many = Clouds(points, torch.zeros(200, dtype=torch.long))
    mapped = corrupt(many, f"{kind}-{severity}").points
    mean_before = points.mean(1, keepdim=True)
    mean_after = mapped.mean(1, keepdim=True)
    return linear_map(points - mean_before, mapped - mean_after)


@pytest.mark.parametrize(
    ("severity", "limit"),
    [
        (1, 15),
        (2, 30),
        (3, 60),
        (4, 90),
        (5, 180),
    ],
)
def test_rotations_reach_the_angle_of_their_severity(severity, limit):
    rotations = maps_of_many("rotation", severity)

    traces = rotations.diagonal(dim1=1, dim2=2).sum(1)
    cosines = (traces - 1) / 2
    degrees = torch.rad2deg(cosines.clamp(-1, 1).acos())
    assert 0.9 * limit < degrees.max() <= limit + 0.1


@pytest.mark.parametrize(
    ("severity", "factor"),
    [
        (1, 1.6),
        (2, 1.7),
        (3, 1.8),
        (4, 1.9),
        (5, 2.0),
    ],
)
def test_axes_are_scaled_up_and_down_by_the_factor_of_their_severity(severity, factor):
    factors = maps_of_many("scaling", severity).diagonal(dim1=1, dim2=2)

    ratios = factors.amax(1) / factors.amin(1)
    assert factor**1.8 < ratios.max() <= factor**2 + 1e-3


@pytest.mark.parametrize("severity", [1, 2, 3, 4, 5])
def test_shear_mixes_coordinates_up_to_the_amount_of_its_severity(severity):
    matrices = maps_of_many("shear", severity)

    scale = matrices[:, :1, :1]
    mixed = matrices / scale - torch.eye(3)
    amount = 0.05 * severity
    assert 0.98 * amount < mixed.amax() <= amount + 1e-4
    assert -amount - 1e-4 <= mixed.amin() < -0.98 * amount


@pytest.mark.parametrize("severity", [1, 5])
def test_distortion_equals_scipys_interpolation_of_its_lattice(clouds, severity):
    distorted = corrupt(clouds, f"distortion-{severity}").points

    nodes = np.linspace(-1, 1, 5)
    for number, (before, after) in enumerate(zip(clouds.points, distorted, strict=True)):
        rng = generator(17, number)
        drawn = torch.rand(3, 5, 5, 5, generator=rng)
        offsets_of_nodes = 0.1 * severity * (2 * drawn - 1)
        lattice = offsets_of_nodes.permute(1, 2, 3, 0).numpy()
        z_y_x = before.flip(1).numpy()
        offsets = interpn((nodes, nodes, nodes), lattice, z_y_x)
        moved = before + torch.from_numpy(offsets)
        centred = moved - moved.mean(0)
        radius = centred.norm(dim=1).max()
        expected = centred / radius
        assert_close(after, expected.float(), atol=1e-5, rtol=0)


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
        mapped_linearly = centred @ matrix
        assert torch.allclose(mapped_linearly, centred_after, atol=1e-4)
        diagonal = matrix.diagonal()
        off_diagonal = (matrix - diagonal.diag()) / diagonal.mean()
        assert off_diagonal.abs().max() <= largest_off_diagonal
        assert diagonal.max() / diagonal.min() <= largest_ratio
        farthest = after.norm(dim=1).max().item()
        assert farthest == pytest.approx(1, abs=1e-5)


def test_distortion_moves_neighbours_alike(clouds):
    cloud = clouds.points[0]
    other = corrupt(clouds, "distortion-1").points[0]
    distances = torch.cdist(cloud, cloud).fill_diagonal_(9)
    nearest = distances.argmin(1)
    shift = other - cloud
    differences = (shift - shift[nearest]).norm(dim=1)
    spread = shift.std(0).norm()
    assert differences.mean() < 0.5 * spread


def test_cutout_cuts_whole_neighbourhoods(clouds):
    hole = round(0.03 * N)
    for s in range(4):
        gone = removed(clouds, "cutout-1", s)
        inside = neighbourhoods(clouds.points[s], hole)
        # The first hole is the neighbourhood of a point; all of it is gone.
        assert (inside & ~gone).sum(1).min() == 0
        assert gone.sum() == 2 * hole


def test_density_down_thins_a_neighbourhood_in_place_of_cutting_a_hole(clouds):
    number_gone = round(0.75 * (N // 10))
    for s in range(4):
        gone = removed(clouds, "density_down-1", s)

        holes = neighbourhoods(clouds.points[s], number_gone)
        is_hole = (holes == gone).all(1)
        assert gone.sum() == number_gone
        assert not is_hole.any()


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


@pytest.mark.parametrize("places", [2, 5])
def test_density_changes_outside_of_every_one_of_several_neighbourhoods(clouds, places):
    size = N // 10
    for number, cloud in enumerate(clouds.points):
        near = neighbourhoods(cloud, size)
        rng = generator(17, number)
        is_kept = torch.zeros(N, dtype=torch.bool)
        for _ in range(places):
            row = torch.randint(N, (), generator=rng)
            is_kept |= near[row]

        gone = removed(clouds, f"density_up-{places}", number)

        assert gone.sum() == 30 * places
        assert not (gone & is_kept).any()


def test_local_drop_is_closer_together_than_global_drop(clouds):
    def spread(kind):
        total = 0.0
        for s, cloud in enumerate(clouds.points):
            gone = removed(clouds, kind, s)
            group = cloud[gone]
            total += torch.cdist(group, group).mean().item()
        return total

    assert spread("drop_local-1") < 0.9 * spread("drop_global-1")


@pytest.mark.parametrize("kind", ["drop_local", "add_local"])
def test_local_corruptions_have_one_to_eight_places(kind):
    """On a line with large gaps between clumps: how many clumps lose or gain points."""
    clumps = torch.arange(20.0).repeat_interleave(20)
    points = torch.zeros(40, N, 3)
    points[:, :, 0] = 100 * clumps + torch.arange(N) * 1e-3
    many = Clouds(points, torch.zeros(40, dtype=torch.long))

    corrupted = corrupt(many, f"{kind}-1").points

    numbers_of_places = []
    for cloud in corrupted:
        clump_of_points = (cloud[:, 0] / 100).round().long()
        counts = clump_of_points.bincount(minlength=20)
        numbers_of_places.append(int((counts != 20).sum()))
    assert min(numbers_of_places) <= 3
    assert 6 <= max(numbers_of_places) <= 16


def test_added_points_are_where_they_should_be(clouds):
    ball = corrupt(clouds, "add_global-5").points[:, N:]
    local = corrupt(clouds, "add_local-5").points[:, N:]
    cube = corrupt(clouds, "background-5").points[:, N:]

    radii = ball.norm(dim=2)
    assert radii.max() <= 1
    volumes = radii.pow(3)
    assert volumes.mean().item() == pytest.approx(0.5, abs=0.1)
    assert 0.95 < cube.abs().max() <= 1
    assert cube.norm(dim=2).max() > 1
    to_cloud = torch.cdist(local, clouds.points).amin(2)
    assert to_cloud.mean() < 0.2


def test_background_has_the_share_of_its_severity():
    points = torch.rand(1, 5040, 3)
    cloud = Clouds(points, torch.zeros(1, dtype=torch.long))

    added = []
    for severity in range(1, 6):
        corrupted = corrupt(cloud, f"background-{severity}")
        added.append(corrupted.points.shape[1] - 5040)

    assert added == [112, 126, 144, 168, 252]


def test_global_points_are_uniform_in_the_ball():
    points = torch.zeros(1, 20_000, 3)
    many = Clouds(points, torch.zeros(1, dtype=torch.long))

    added = corrupt(many, "add_global-5").points[0, 20_000:]

    volumes = added.norm(dim=1).pow(3)
    shares, _ = torch.histogram(volumes, 4, range=(0, 1))
    assert len(added) == 1000
    assert (shares / 1000).tolist() == pytest.approx([0.25] * 4, abs=0.05)


def test_local_points_are_added_at_distances_of_about_a_tenth():
    """Around one place: the standard deviation is from 0.075 to 0.125 along every axis."""
    points = torch.zeros(20, N, 3)
    many = Clouds(points, torch.zeros(20, dtype=torch.long))

    added = corrupt(many, "add_local-5").points[:, N:]

    spread = added.square().mean().sqrt().item()
    assert spread == pytest.approx(0.1, abs=0.01)


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

    with_parts = clouds._replace(parts=parts)

    corrupted = corrupt(with_parts, f"{kind}-3")

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
    points = torch.cat([normals, intensity, normals], 2)
    return clouds._replace(points=points)


@pytest.mark.parametrize("kind", KINDS)
def test_coordinates_are_corrupted_as_without_channels(clouds, kind):
    spec = f"{kind}-3"
    given = with_channels(clouds)
    coordinates = given.points[..., :3].contiguous()

    corrupted = corrupt(given, spec, NORMALS).points

    without_channels = corrupt(given._replace(points=coordinates), spec).points
    assert_close(corrupted[..., :3], without_channels)


@pytest.mark.parametrize("kind", SHRUNK)
def test_removal_keeps_the_channels_of_points(clouds, kind):
    given = with_channels(clouds)

    corrupted = corrupt(given, f"{kind}-3", NORMALS).points

    for cloud, before in zip(corrupted, given.points, strict=True):
        rows = cloud[:, 3].long()
        assert torch.equal(cloud, before[rows])


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
        assert rows.tolist() != list(range(len(added)))


def test_rotation_turns_normals(clouds):
    given = with_channels(clouds)

    corrupted = corrupt(given, "rotation-5", NORMALS).points

    normals = corrupted[..., 4:]
    assert_close(normals, corrupted[..., :3], atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("kind", ["scaling", "shear"])
def test_linear_map_keeps_normals_normal_to_the_surface(clouds, kind):
    given = with_channels(clouds)

    corrupted = corrupt(given, f"{kind}-5", NORMALS).points

    # Tangents of the sphere, mapped as differences of points, stay orthogonal to the normals.
    direction = torch.tensor([0.3, 0.5, 0.8]).expand(N, 3)
    for before, after in zip(given.points, corrupted, strict=True):
        sphere = before[:, :3]
        ones = torch.ones(N, 1)
        homogeneous = torch.cat([sphere, ones], 1)
        affine = linear_map(homogeneous, after[:, :3])
        tangents = torch.linalg.cross(sphere, direction)
        mapped = tangents @ affine[:3]
        normals = after[:, 4:]
        products = (mapped * normals).sum(1)
        assert products.abs().max() < 1e-4
        lengths = normals.norm(dim=1)
        assert_close(lengths, torch.ones(N))


def test_local_corruptions_divide_their_points_among_any_of_one_to_eight_places():
    numbers = set()
    for seed in range(60):
        sizes = _split(1000, torch.Generator().manual_seed(seed))
        numbers.add(len(sizes))
        assert sum(sizes) == 1000

    assert numbers == {1, 2, 3, 4, 5, 6, 7, 8}
