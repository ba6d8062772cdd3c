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


def test_loader_order_depends_on_seed_and_epoch():
    first, second = (CloudLoader(clouds(), 4, shuffle=True, seed=5) for _ in range(2))
    epochs = [labels(first) for _ in range(3)]
    assert epochs[0] != epochs[1] != epochs[2]
    second.set_epoch(2)
    assert labels(second) == epochs[2]
    assert labels(CloudLoader(clouds(), 4, shuffle=True, seed=6)) != epochs[0]
    assert sorted(label for batch in epochs[0] for label in batch) == list(range(10))


def test_loader_drop_last_keeps_only_batch():
    assert len(CloudLoader(clouds(), 4, drop_last=True)) == 2
    assert len(CloudLoader(clouds(), 32, drop_last=True)) == 1


def test_loader_augments_anew_in_every_batch_and_epoch():
    loader = CloudLoader(clouds(), 4, augment=Augmentation(jitter=0.01), seed=1)
    first, second = (torch.cat([batch.points for batch in loader]) for _ in range(2))
    assert (first != second).any(2).all()
    noise = first - clouds().points
    assert not torch.allclose(noise[:4], noise[4:8], atol=1e-4)


def test_augmentation_jitter_is_clipped(rng, monkeypatch):
    points = torch.zeros(8, 5000, 3)
    noise = Augmentation(jitter=0.1)(points, rng)
    assert noise.std().item() == pytest.approx(0.1, rel=0.02)
    monkeypatch.setattr("mops_lightning.data.loader.JITTER_CLIP", 2)
    clipped = Augmentation(jitter=0.1)(points, rng)
    assert clipped.abs().max() == pytest.approx(0.2)


def test_augmentation_stretches_and_shifts_every_axis_of_a_cloud(rng):
    points = clouds(300).points
    changed = Augmentation(stretch=1.5, shift=0.2)(points, rng)
    scale = (changed[:, 1] - changed[:, 0]) / (points[:, 1] - points[:, 0])
    offset = changed[:, 0] - scale * points[:, 0]
    torch.testing.assert_close(
        changed, points * scale[:, None] + offset[:, None], atol=1e-3, rtol=0
    )
    for drawn, low, high in ((scale, 1 / 1.5, 1.5), (offset, -0.2, 0.2)):
        assert low - 1e-3 < drawn.min() < low + 0.05
        assert high - 0.05 < drawn.max() < high + 1e-3
        assert drawn.mean().item() == pytest.approx((low + high) / 2, abs=0.05)
        of_axes = torch.corrcoef(drawn.T) - torch.eye(3)
        assert of_axes.abs().max() < 0.2  # every axis has factors and shifts of its own


def test_augmentation_equals_written_out_formulas():
    points = clouds(300).points
    rng = torch.Generator().manual_seed(3)
    got = Augmentation(rotate_up=True, jitter=0.04)(points, rng)
    rng.manual_seed(3)
    angles = torch.rand(300, generator=rng) * 2 * math.pi
    noise = 0.04 * torch.randn(points.shape, generator=rng)
    x, y, z = points.unbind(2)
    cos = angles.cos()[:, None]
    sin = angles.sin()[:, None]
    turned = torch.stack([x * cos - z * sin, y, x * sin + z * cos], 2)
    torch.testing.assert_close(got, turned + noise.clamp(-0.2, 0.2))


@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_augmentation_turns_about_its_vertical_axis(up):
    points = clouds(20).points
    axis = "xyz".index(up)
    turned = Augmentation(rotate_up=up)(points, torch.Generator().manual_seed(3))
    torch.testing.assert_close(turned[..., axis], points[..., axis])
    # As about y, after the axes were moved in a circle, which mirrors nothing.
    moved = points.roll(1 - axis, 2)
    about_y = Augmentation(rotate_up=True)(moved, torch.Generator().manual_seed(3))
    torch.testing.assert_close(turned, about_y.roll(axis - 1, 2))
    assert not torch.allclose(turned, points)
    assert torch.equal(Augmentation()(points, torch.Generator()), points)


def test_augmentation_invalid_argument_raises():
    with pytest.raises(UserError, match=r"rotate_up must be true, false, x, y or z .* got 'w'"):
        Augmentation(rotate_up="w")  # type: ignore[arg-type]
    with pytest.raises(UserError, match=r"jitter .* at least 0, got -1.0"):
        Augmentation(jitter=-1.0)


def drawn(loader):
    """The number that the task draws for each cloud, by label."""
    return {label: number for batch in loader for label, number in batch}


@pytest.mark.parametrize("shuffle", [False, True])
def test_loader_task_draws_by_cloud_and_in_training_by_epoch(shuffle):
    known = clouds().points

    def make_batch(points, generators):
        numbers = [float(torch.rand((), generator=one)) for one in generators]
        rows = [int((known == cloud).all((1, 2)).nonzero()) for cloud in points]
        return list(zip(rows, numbers, strict=True))

    def loader(batch_size=4, seed=5):
        return CloudLoader(clouds(), batch_size, shuffle, make_batch=make_batch, seed=seed)

    first = loader()
    epochs = [drawn(first), drawn(first)]
    # Test pairs stay the same for ever, training pairs for a seed and an epoch.
    streams = [(12, 5, epoch) if shuffle else (11, 5) for epoch in range(2)]
    assert epochs == [
        {row: float(torch.rand((), generator=generator(*stream, row))) for row in range(10)}
        for stream in streams
    ]
    assert (epochs[0] == epochs[1]) != shuffle
    assert drawn(loader(batch_size=3)) == epochs[0]
    assert drawn(loader(seed=6)) != epochs[0]
    if not shuffle:
        assert loader().batch_of(torch.tensor([7, 2])) == [(row, epochs[0][row]) for row in (7, 2)]


def loaders(number, processes, batch_size=8, **extra):
    return [
        CloudLoader(clouds(number), batch_size, part=(rank, processes), **extra)
        for rank in range(processes)
    ]


@pytest.mark.parametrize("number", [16, 29])
def test_loader_shares_of_training_batch_form_whole_batch(number):
    settings = {"shuffle": True, "drop_last": True, "augment": Augmentation(True, 0.1)}
    (alone,) = loaders(number, 1, **settings)
    for whole, *shares in zip(alone, *loaders(number, 2, **settings), strict=True):
        assert len({len(share.points) for share in shares}) == 1
        assert torch.equal(torch.cat([share.points for share in shares]), whole.points)
        assert torch.equal(torch.cat([share.labels for share in shares]), whole.labels)


def test_loader_indivisible_batch_drops_last_clouds():
    first, second = (list(loader) for loader in loaders(7, 2, shuffle=True))
    assert [len(batch.points) for batch in (*first, *second)] == [3, 3]


@pytest.mark.parametrize("processes", [1, 2, 3, 4])
def test_loader_test_split_scores_each_cloud_once(processes):
    for number in range(processes, 60):
        shares = [list(loader) for loader in loaders(number, processes)]
        assert {len(share) for share in shares} == {-(-number // 8)}
        sizes = [len(batch.points) for share in shares for batch in share]
        assert min(sizes) > 0
        labels = torch.cat([batch.labels for share in shares for batch in share])
        assert torch.equal(labels.sort().values, torch.arange(number))


INTENSITY_AND_NORMALS = PointChannels(
    [Channel("intensity"), Channel("normal_x"), Channel("normal_y"), Channel("normal_z")]
)


def sphere(rng):
    """Points of unit spheres with an intensity and their normals, which are the points."""
    places = torch.nn.functional.normalize(torch.randn(2, 50, 3, generator=rng), dim=2)
    return torch.cat([places, torch.rand(2, 50, 1, generator=rng), places], 2)


@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_augmentation_turns_normals_with_the_cloud(up, rng):
    points = sphere(rng)

    turned = Augmentation(rotate_up=up)(points, generator(1), INTENSITY_AND_NORMALS)

    torch.testing.assert_close(turned[..., 4:], turned[..., :3])
    assert torch.equal(turned[..., 3], points[..., 3])
    assert not torch.allclose(turned[..., :3], points[..., :3])


def test_augmentation_keeps_normals_normal_to_a_stretched_surface(rng):
    points = sphere(rng)

    stretched = Augmentation(stretch=3.0)(points, generator(1), INTENSITY_AND_NORMALS)

    # The normal of an ellipsoid with the half axes a is x / a².
    axes = stretched[..., :3].abs().div(points[..., :3].abs()).median(1, keepdim=True).values
    expected = torch.nn.functional.normalize(stretched[..., :3] / axes.square(), dim=2)
    torch.testing.assert_close(stretched[..., 4:], expected, atol=1e-5, rtol=1e-4)
    assert torch.equal(stretched[..., 3], points[..., 3])


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
