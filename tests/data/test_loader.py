import itertools
import math

import pytest
import torch

from mops_lightning.channels import Channel, PointChannels
from mops_lightning.data.clouds import Clouds
from mops_lightning.data.loader import Augmentation, CloudLoader
from mops_lightning.errors import UserError
from mops_lightning.seeding import generator


def clouds(number=10, points=7):
    rng = torch.Generator().manual_seed(0)
    return Clouds(torch.randn(number, points, 3, generator=rng), torch.arange(number))


def labels(loader):
    return [batch.labels.tolist() for batch in loader]


def test_loader_without_shuffle_keeps_order_also_after_an_interrupted_iteration():
    loader = CloudLoader(clouds(), 4)
    next(iter(loader))
    assert labels(loader) == labels(loader) == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9]]
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
    assert len(CloudLoader(clouds(), 4, drop_last=True)) == 2
    assert len(CloudLoader(clouds(), 32, drop_last=True)) == 1


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


def test_augmentation_jitter_is_clipped(rng, monkeypatch):
    points = torch.zeros(8, 5000, 3)
    noise = Augmentation(jitter=0.1)(points, rng)
    assert noise.std().item() == pytest.approx(0.1, rel=0.02)
    monkeypatch.setattr("mops_lightning.data.loader.JITTER_CLIP", 2)
    clipped = Augmentation(jitter=0.1)(points, rng)
    assert clipped.abs().max() == pytest.approx(0.2)


def test_augmentation_stretches_and_shifts_every_axis_of_a_cloud(rng):
    points = clouds(300).points
    augment = Augmentation(stretch=1.5, shift=0.2)

    changed = augment(points, rng)

    edge = points[:, 1] - points[:, 0]
    changed_edge = changed[:, 1] - changed[:, 0]
    scale = changed_edge / edge
    offset = changed[:, 0] - scale * points[:, 0]
    expected = points * scale[:, None] + offset[:, None]
    torch.testing.assert_close(changed, expected, atol=1e-3, rtol=0)
    assert_drawn_for_every_axis(scale, 1 / 1.5, 1.5)
    assert_drawn_for_every_axis(offset, -0.2, 0.2)


def assert_drawn_for_every_axis(drawn, low, high):
    """Assert numbers that fill a range evenly and differ between the axes."""
    assert low - 1e-3 < drawn.min() < low + 0.05
    assert high - 0.05 < drawn.max() < high + 1e-3
    middle = (low + high) / 2
    assert drawn.mean().item() == pytest.approx(middle, abs=0.05)
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
    torch.testing.assert_close(augmented, turned + noise.clamp(-0.2, 0.2))


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
    torch.testing.assert_close(turned[..., axis], points[..., axis])
    torch.testing.assert_close(turned, turned_about_y.roll(axis - 1, 2))
    assert not torch.allclose(turned, points)


def test_augmentation_invalid_argument_raises():
    with pytest.raises(UserError, match=r"rotate_up must be true, false, x, y or z .* got 'w'"):
        Augmentation(rotate_up="w")  # type: ignore[arg-type]
    with pytest.raises(UserError, match=r"jitter .* at least 0, got -1.0"):
        Augmentation(jitter=-1.0)


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
            number = float(torch.rand((), generator=rng))
            labelled.append((int(is_cloud.nonzero()), number))
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
        batch = loader().batch_of(torch.tensor([7, 2]))
        assert batch == [(7, first_epoch[7]), (2, first_epoch[2])]
    assert drawn(loader(batch_size=3)) == first_epoch
    assert drawn(loader(seed=6)) != first_epoch


def loaders(number, processes, batch_size=8, **extra):
    return [
        CloudLoader(clouds(number), batch_size, part=(rank, processes), **extra)
        for rank in range(processes)
    ]


@pytest.mark.parametrize("number", [16, 29])
def test_loader_shares_of_training_batch_form_whole_batch(number):
    augment = Augmentation(True, 0.1)
    settings = {"shuffle": True, "drop_last": True, "augment": augment}
    (alone,) = loaders(number, 1, **settings)
    first, second = loaders(number, 2, **settings)

    for whole, left, right in zip(alone, first, second, strict=True):
        assert len(left.points) == len(right.points)
        assert torch.equal(torch.cat([left.points, right.points]), whole.points)
        assert torch.equal(torch.cat([left.labels, right.labels]), whole.labels)


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
        assert sorted(seen) == list(range(number))


INTENSITY_AND_NORMALS = PointChannels(
    [Channel("intensity"), Channel("normal_x"), Channel("normal_y"), Channel("normal_z")]
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
    torch.testing.assert_close(turned_normals, turned_coordinates)
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
    torch.testing.assert_close(stretched_normals, expected, atol=1e-5, rtol=1e-4)
    assert torch.equal(stretched_intensity, intensity)


def test_augmentation_moves_coordinates_as_without_channels(rng):
    points = sphere(rng)
    augment = Augmentation("z", 0.1, 2.0, 0.3)

    with_channels = augment(points, generator(1), INTENSITY_AND_NORMALS)
    without = augment(points[..., :3].contiguous(), generator(1))

    torch.testing.assert_close(with_channels[..., :3], without)


def test_loader_gives_channels_to_the_augmentation(rng):
    points = sphere(rng)
    split = Clouds(points, torch.arange(2))
    loader = CloudLoader(
        split, 2, augment=Augmentation(rotate_up="z"), channels=INTENSITY_AND_NORMALS
    )

    (batch,) = list(loader)

    torch.testing.assert_close(batch.points[..., 4:], batch.points[..., :3])
