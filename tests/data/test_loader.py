import pytest
import torch

from mops_lightning.data.clouds import Clouds, choose_classes
from mops_lightning.data.loader import Augmentation, CloudLoader
from mops_lightning.errors import UserError


def clouds(number=10, points=7):
    rng = torch.Generator().manual_seed(0)
    return Clouds(torch.randn(number, points, 3, generator=rng), torch.arange(number))


def labels(loader):
    return [batch.labels.tolist() for batch in loader]


def test_unshuffled_batches_hold_every_cloud_in_order():
    loader = CloudLoader(clouds(), 4)
    assert labels(loader) == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9]]
    assert labels(loader) == labels(loader)
    assert len(loader) == 3


def test_order_hangs_on_seed_and_epoch_only():
    first, second = (CloudLoader(clouds(), 4, shuffle=True, seed=5) for _ in range(2))
    epochs = [labels(first) for _ in range(3)]
    assert epochs[0] != epochs[1] != epochs[2]
    second.set_epoch(2)
    assert labels(second) == epochs[2]
    assert labels(CloudLoader(clouds(), 4, shuffle=True, seed=6)) != epochs[0]
    assert sorted(label for batch in epochs[0] for label in batch) == list(range(10))


def test_drop_last_keeps_full_batches_only_unless_there_is_none():
    assert len(CloudLoader(clouds(), 4, drop_last=True)) == 2
    assert len(CloudLoader(clouds(), 32, drop_last=True)) == 1


def test_resumes_in_the_middle_of_an_epoch():
    augment = Augmentation(rotate_up=True, jitter=0.01)
    unbroken = CloudLoader(clouds(), 3, shuffle=True, augment=augment, seed=1)
    want = [b.points for _ in range(2) for b in unbroken]
    stopped = CloudLoader(clouds(), 3, shuffle=True, augment=augment, seed=1)
    seen = [b.points for b in stopped]
    iterator = iter(stopped)
    seen.append(next(iterator).points)
    resumed = CloudLoader(clouds(), 3, shuffle=True, augment=augment, seed=1)
    resumed.load_state_dict(stopped.state_dict())
    resumed.set_epoch(1)
    seen += [b.points for b in resumed]
    assert len(seen) == len(want)
    assert all(torch.equal(a, b) for a, b in zip(seen, want, strict=True))


def test_a_broken_off_pass_does_not_shorten_the_next():
    loader = CloudLoader(clouds(), 4)
    next(iter(loader))
    assert len(labels(loader)) == 3


def test_rotation_is_about_the_up_axis_and_keeps_lengths(rng):
    points = clouds().points
    turned = Augmentation(rotate_up=True)(points, rng)
    torch.testing.assert_close(turned[..., 1], points[..., 1])
    torch.testing.assert_close(torch.cdist(turned, turned), torch.cdist(points, points))
    assert not torch.allclose(turned, points)


def test_jitter_is_clipped_and_of_the_size_asked_for(rng):
    points = torch.zeros(8, 5000, 3)
    noise = Augmentation(jitter=0.01, jitter_clip=0.02)(points, rng)
    assert noise.abs().max() == pytest.approx(0.02)
    wide = Augmentation(jitter=0.01, jitter_clip=1.0)(points, rng)
    assert wide.std().item() == pytest.approx(0.01, rel=0.02)


def test_no_augmentation_changes_nothing(rng):
    points = clouds().points
    assert torch.equal(Augmentation()(points, rng), points)


def test_negative_jitter_is_refused():
    with pytest.raises(UserError, match="jitter"):
        Augmentation(jitter=-1.0)


def test_classes_given_as_one_word_are_asked_for_as_a_list():
    with pytest.raises(UserError, match=r"must be a list, such as \[chair\]"):
        choose_classes("chair", ["chair", "table"])
