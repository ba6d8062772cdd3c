import pytest
import torch

from mops_lightning.seeding import generator
from mops_lightning.training.run.build import split
from tests.support.training import small_dataset


def rows(part, whole):
    """Rows of a part's clouds in the whole split."""
    numbers = []
    for cloud in part:
        is_same = (whole == cloud).all(2).all(1)
        numbers.append(int(is_same.nonzero()))
    return numbers


def test_split_holds_out_fraction_in_order():
    clouds = small_dataset(train=20).train

    train, held_out = split(clouds, 0.2, seed=5)

    kept = rows(train.points, clouds.points)
    out = rows(held_out.points, clouds.points)
    together = sorted([*kept, *out])
    assert len(out) == 4
    assert together == list(range(20))
    assert kept == sorted(kept)
    assert out == sorted(out)
    assert torch.equal(held_out.labels, clouds.labels[out])
    # The stream of random numbers stays, so that old runs can be repeated.
    order = torch.randperm(20, generator=generator(5, 2))
    assert out == sorted(order[:4].tolist())


@pytest.mark.parametrize(("fraction", "number"), [(0.19, 4), (0.21, 4), (1.0, 20)])
def test_split_holds_out_the_nearest_whole_number(fraction, number):
    clouds = small_dataset(train=20).train

    train, held_out = split(clouds, fraction, seed=5)

    assert len(held_out.points) == number
    assert len(train.points) == 20 - number


def test_split_of_no_share_holds_out_nothing():
    clouds = small_dataset(train=20).train

    train, held_out = split(clouds, 0.0, seed=5)

    assert len(train.points) == 20
    assert len(held_out.points) == 0


def test_split_holds_out_whole_sources():
    sources = torch.arange(5).repeat_interleave(4)
    clouds = small_dataset(train=20).train._replace(sources=sources)

    _, held_out = split(clouds, 0.4, seed=5)

    assert held_out.sources is not None
    _, counts = held_out.sources.unique(return_counts=True)
    assert counts.tolist() == [4, 4]
