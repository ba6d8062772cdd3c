import itertools
import math

import pytest
import torch
from torch.testing import assert_close

from mops_lightning.channels import Channel, PointChannels
from mops_lightning.data.clouds import Clouds
from mops_lightning.data.loader import Augmentation, CloudLoader
from mops_lightning.errors import UserError
from mops_lightning.seeding import generator


def clouds(number=10, points=7):
    rng = torch.Generator().manual_seed(0)
    normal = torch.randn(number, points, 3, generator=rng)
    return Clouds(normal, torch.arange(number))


def labels(loader):
    return [batch.labels.tolist() for batch in loader]


def test_loader_without_shuffle_keeps_order_also_after_an_interrupted_iteration():
    loader = CloudLoader(clouds(), 4)
    next(iter(loader))

    first = labels(loader)
    second = labels(loader)

    assert first == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9]]
    assert second == first
    assert len(loader) == 3


def points_of(loader):
    return torch.cat([batch.points for batch in loader])


def test_loader_order_depends_on_seed_and_epoch():
    loader = CloudLoader(clouds(), 4, shuffle=True, seed=5)
    same_seed = CloudLoader(clouds(), 4, shuffle=True, seed=5)
    other_seed = CloudLoader(clouds(), 4, shuffle=True, seed=6)

    first = labels(loader)
    second = labels(loader)
    third = labels(loader)

    assert first != second
    assert second != third
    assert sorted(itertools.chain(*first)) == [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]
    assert labels(other_seed) != first
    same_seed.set_epoch(2)
    assert labels(same_seed) == third


def test_loader_drop_last_keeps_only_batch():
    several = CloudLoader(clouds(), 4, drop_last=True)
    only = CloudLoader(clouds(), 32, drop_last=True)

    assert len(several) == 2
    assert len(only) == 1


def test_loader_augments_anew_in_every_batch_and_epoch():
    augment = Augmentation(jitter=0.01)
    loader = CloudLoader(clouds(), 4, augment=augment, seed=1)

    first = points_of(loader)
    second = points_of(loader)

    assert (first != second).any(2).all()
    noise = first - clouds().points
    first_batch = noise[:4]
    second_batch = noise[4:8]
    assert not torch.allclose(first_batch, second_batch, atol=1e-4)
    of_seed = points_of(CloudLoader(clouds(), 4, augment=augment, seed=1))
    of_other_seed = points_of(CloudLoader(clouds(), 4, augment=augment, seed=2))
    assert torch.equal(of_seed, first)
    assert (of_other_seed != first).any(2).all()


def test_augmentation_jitter_is_clipped(rng, monkeypatch):
    points = torch.zeros(8, 5000, 3)
    augment = Augmentation(jitter=0.1)

    noise = augment(points, rng)
    monkeypatch.setattr("mops_lightning.data.loader.JITTER_CLIP", 2)
    clipped = augment(points, rng)

    assert noise.std().item() == pytest.approx(0.1, rel=0.02)
    assert clipped.abs().max() == pytest.approx(0.2)


def test_augmentation_jitter_is_clipped_at_five_standard_deviations():
    points = torch.zeros(1, 1_000_000, 3)
    unclipped = torch.randn(points.shape, generator=torch.Generator().manual_seed(0))
    assert unclipped.abs().max() > 5

    noise = Augmentation(jitter=1.0)(points, torch.Generator().manual_seed(0))

    assert torch.equal(noise, unclipped.clamp(-5, 5))


def test_augmentation_shifts_without_stretching(rng):
    points = clouds(300).points

    shifted = Augmentation(shift=0.2)(points, rng)

    offset = shifted[:, 0] - points[:, 0]
    assert_close(shifted, points + offset[:, None], atol=1e-5, rtol=0)
    assert_drawn_for_every_axis(offset, -0.2, 0.2)


def test_augmentation_stretches_and_shifts_every_axis_of_a_cloud(rng):
    points = clouds(300).points
    augment = Augmentation(stretch=1.5, shift=0.2)

    changed = augment(points, rng)

    edge = points[:, 1] - points[:, 0]
    changed_edge = changed[:, 1] - changed[:, 0]
    scale = changed_edge / edge
    offset = changed[:, 0] - scale * points[:, 0]
    expected = points * scale[:, None] + offset[:, None]
    assert_close(changed, expected, atol=1e-3, rtol=0)
    assert_drawn_for_every_axis(scale, 1 / 1.5, 1.5)
    assert_drawn_for_every_axis(offset, -0.2, 0.2)


def assert_drawn_for_every_axis(drawn, low, high):
    """Assert numbers that fill a range evenly and differ between the axes."""
    assert low - 1e-3 < drawn.min() < low + 0.05
    assert high - 0.05 < drawn.max() < high + 1e-3
    middle = (low + high) / 2
    mean = drawn.mean().item()
    assert mean == pytest.approx(middle, abs=0.05)
    between_axes = torch.corrcoef(drawn.T) - torch.eye(3)
    assert between_axes.abs().max() < 0.2


def test_augmentation_equals_written_out_formulas():
    points = clouds(300).points
    augment = Augmentation(rotate_up=True, jitter=0.04)

    augmented = augment(points, torch.Generator().manual_seed(3))

    rng = torch.Generator().manual_seed(3)
    angles = torch.rand(300, generator=rng) * 2 * math.pi
    noise = 0.04 * torch.randn(points.shape, generator=rng)
    x, y, z = points.unbind(2)
    cos = angles.cos()[:, None]
    sin = angles.sin()[:, None]
    turned_x = x * cos - z * sin
    turned_z = x * sin + z * cos
    turned = torch.stack([turned_x, y, turned_z], 2)
    expected = turned + noise.clamp(-0.2, 0.2)
    assert_close(augmented, expected)


@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_augmentation_turns_about_its_vertical_axis(up):
    points = clouds(20).points
    axis = "xyz".index(up)
    # As about y, after the axes were moved in a circle, which mirrors nothing.
    moved = points.roll(1 - axis, 2)
    about_y = Augmentation(rotate_up=True)
    about_up = Augmentation(rotate_up=up)

    turned = about_up(points, torch.Generator().manual_seed(3))

    turned_about_y = about_y(moved, torch.Generator().manual_seed(3))
    expected = turned_about_y.roll(axis - 1, 2)
    heights = turned[..., axis]
    assert_close(heights, points[..., axis])
    assert_close(turned, expected)
    assert not torch.allclose(turned, points)


def test_augmentation_invalid_argument_raises():
    with pytest.raises(UserError, match=r"rotate_up must be true, false, x, y or z .* got 'w'"):
        Augmentation(rotate_up="w")  # type: ignore[arg-type]
    with pytest.raises(UserError, match=r"jitter .* at least 0, got -1.0"):
        Augmentation(jitter=-1.0)
    with pytest.raises(UserError, match=r"shift .* at least 0, got -0.1"):
        Augmentation(shift=-0.1)
    with pytest.raises(UserError, match=r"stretch .* at least 1, got 0.9"):
        Augmentation(stretch=0.9)


def test_augmentation_without_settings_changes_nothing():
    points = clouds(20).points

    augmented = Augmentation()(points, torch.Generator())

    assert torch.equal(augmented, points)


def drawn(loader):
    """The number that the task draws for each cloud, by label."""
    numbers = {}
    for batch in loader:
        numbers.update(batch)
    return numbers


@pytest.mark.parametrize("shuffle", [False, True])
def test_loader_task_draws_by_cloud_and_in_training_by_epoch(shuffle):
    known = clouds().points

    def make_batch(points, generators):
        labelled = []
        for cloud, rng in zip(points, generators, strict=True):
            is_cloud = (known == cloud).all((1, 2))
            label = int(is_cloud.nonzero())
            number = float(torch.rand((), generator=rng))
            labelled.append((label, number))
        return labelled

    def loader(batch_size=4, seed=5):
        return CloudLoader(clouds(), batch_size, shuffle, make_batch=make_batch, seed=seed)

    def numbers_of_stream(*stream):
        numbers = {}
        for label in range(10):
            rng = generator(*stream, label)
            numbers[label] = float(torch.rand((), generator=rng))
        return numbers

    first_loader = loader()
    first_epoch = drawn(first_loader)
    second_epoch = drawn(first_loader)

    # Test pairs stay the same for ever, training pairs for a seed and an epoch.
    if shuffle:
        assert first_epoch == numbers_of_stream(12, 5, 0)
        assert second_epoch == numbers_of_stream(12, 5, 1)
        assert second_epoch != first_epoch
    else:
        assert first_epoch == numbers_of_stream(11, 5)
        assert second_epoch == first_epoch
        rows = torch.tensor([7, 2])
        batch = loader().batch_of(rows)
        assert batch == [(7, first_epoch[7]), (2, first_epoch[2])]
    assert drawn(loader(batch_size=3)) == first_epoch
    assert drawn(loader(seed=6)) != first_epoch


def loaders(number, processes, batch_size=8, **extra):
    split = clouds(number)
    shares = []
    for rank in range(processes):
        loader = CloudLoader(split, batch_size, part=(rank, processes), **extra)
        shares.append(loader)
    return shares


@pytest.mark.parametrize("number", [16, 29])
def test_loader_shares_of_training_batch_form_whole_batch(number):
    augment = Augmentation(True, 0.1)
    settings = {"shuffle": True, "drop_last": True, "augment": augment}
    (alone,) = loaders(number, 1, **settings)
    first, second = loaders(number, 2, **settings)

    for whole, left, right in zip(alone, first, second, strict=True):
        points = torch.cat([left.points, right.points])
        labels = torch.cat([left.labels, right.labels])
        assert len(left.points) == len(right.points)
        assert torch.equal(points, whole.points)
        assert torch.equal(labels, whole.labels)


def test_loader_indivisible_batch_drops_last_clouds():
    first, second = loaders(7, 2, shuffle=True)

    (first_batch,) = first
    (second_batch,) = second

    assert len(first_batch.points) == 3
    assert len(second_batch.points) == 3


@pytest.mark.parametrize("processes", [1, 2, 3, 4])
def test_loader_test_split_scores_each_cloud_once(processes):
    for number in range(processes, 60):
        batches_of_each = -(-number // 8)
        seen = []
        for loader in loaders(number, processes):
            batches = list(loader)
            assert len(batches) == batches_of_each
            for batch in batches:
                assert len(batch.points) > 0
                seen.extend(batch.labels.tolist())
        everything = list(range(number))
        assert sorted(seen) == everything


INTENSITY_AND_NORMALS = PointChannels(
    [
        Channel("intensity"),
        Channel("normal_x"),
        Channel("normal_y"),
        Channel("normal_z"),
    ]
)


def sphere(rng):
    """Points of unit spheres with an intensity and their normals, which are the points."""
    directions = torch.randn(2, 50, 3, generator=rng)
    normals = torch.nn.functional.normalize(directions, dim=2)
    intensity = torch.rand(2, 50, 1, generator=rng)
    return torch.cat([normals, intensity, normals], 2)


def split_channels(points):
    """Return coordinates, intensities and normals."""
    return points[..., :3], points[..., 3], points[..., 4:]


@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_augmentation_turns_normals_with_the_cloud(up, rng):
    points = sphere(rng)
    augment = Augmentation(rotate_up=up)

    turned = augment(points, generator(1), INTENSITY_AND_NORMALS)

    coordinates, intensity, _ = split_channels(points)
    turned_coordinates, turned_intensity, turned_normals = split_channels(turned)
    assert_close(turned_normals, turned_coordinates)
    assert torch.equal(turned_intensity, intensity)
    assert not torch.allclose(turned_coordinates, coordinates)


def test_augmentation_keeps_normals_normal_to_a_stretched_surface(rng):
    points = sphere(rng)
    augment = Augmentation(stretch=3.0)

    stretched = augment(points, generator(1), INTENSITY_AND_NORMALS)

    coordinates, intensity, _ = split_channels(points)
    stretched_coordinates, stretched_intensity, stretched_normals = split_channels(stretched)
    factors = stretched_coordinates.abs() / coordinates.abs()
    half_axes = factors.median(1, keepdim=True).values
    # The normal of an ellipsoid with the half axes a is x / a².
    gradient = stretched_coordinates / half_axes.square()
    expected = torch.nn.functional.normalize(gradient, dim=2)
    assert_close(stretched_normals, expected, atol=1e-5, rtol=1e-4)
    assert torch.equal(stretched_intensity, intensity)


def test_augmentation_moves_coordinates_as_without_channels(rng):
    points = sphere(rng)
    coordinates = points[..., :3].contiguous()
    augment = Augmentation("z", 0.1, 2.0, 0.3)

    with_channels = augment(points, generator(1), INTENSITY_AND_NORMALS)
    without = augment(coordinates, generator(1))

    assert_close(with_channels[..., :3], without)


def test_loader_gives_channels_to_the_augmentation(rng):
    points = sphere(rng)
    split = Clouds(points, torch.arange(2))
    augment = Augmentation(rotate_up="z")
    loader = CloudLoader(split, 2, augment=augment, channels=INTENSITY_AND_NORMALS)

    (batch,) = list(loader)

    coordinates, _, normals = split_channels(batch.points)
    assert_close(normals, coordinates)


@pytest.mark.parametrize(
    ("settings", "keeps"),
    [
        ({}, True),
        ({"shuffle": True}, True),
        ({"augment": Augmentation()}, True),
        ({"augment": Augmentation(jitter=0.1)}, False),
        ({"make_batch": lambda points, _: points}, False),
    ],
    ids=["plain", "shuffled", "augmentation of nothing", "augmented", "converted"],
)
def test_loader_keeps_clouds_that_nothing_changes(settings, keeps):
    loader = CloudLoader(clouds(), 4, **settings)

    assert loader.keeps_clouds == keeps


@pytest.mark.parametrize(("shuffle", "keeps"), [(False, True), (True, False)])
def test_loader_of_different_sizes_keeps_clouds_only_without_shuffle(shuffle, keeps):
    split = clouds()._replace(sizes=torch.arange(1, 11))

    loader = CloudLoader(split, 4, shuffle)

    assert loader.keeps_clouds == keeps


@pytest.mark.parametrize("number_seen", [1, 2])
def test_loader_continues_from_a_saved_position_with_the_rest_of_the_epoch(number_seen):
    loader = CloudLoader(clouds(), 4, shuffle=True)
    epoch = labels(CloudLoader(clouds(), 4, shuffle=True))
    batches = iter(loader)
    for _ in range(number_seen):
        next(batches)
    resumed = CloudLoader(clouds(), 4, shuffle=True)

    resumed.load_state_dict(loader.state_dict())

    assert labels(resumed) == epoch[number_seen:]
    assert len(labels(resumed)) == 3


def test_loader_parts_of_points_belong_to_the_clouds_of_its_process():
    parts = torch.arange(70).view(10, 7)
    split = clouds()._replace(parts=parts)

    for rank in (0, 1):
        for batch in CloudLoader(split, 4, shuffle=True, part=(rank, 2)):
            assert torch.equal(batch.parts, parts[batch.rows])
            assert torch.equal(batch.points, split.points[batch.rows])


def test_loader_begins_another_epoch_at_its_first_batch_after_a_saved_position():
    loader = CloudLoader(clouds(), 4)
    loader.load_state_dict({"epoch": 0, "position": 2})

    loader.set_epoch(1)

    assert labels(loader) == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9]]
