import torch

from mops_lightning.seeding import generator
from mops_lightning.training.run.build import split
from tests.support.training import small_dataset


def rows(part, whole):
    """Rows of a part's clouds in the whole split."""
    return [int((whole == cloud).all(2).all(1).nonzero()) for cloud in part]


def test_split_holds_out_fraction_in_order():
    clouds = small_dataset(train=20).train

    train, held_out = split(clouds, 0.2, seed=5)

    kept = rows(train.points, clouds.points)
    out = rows(held_out.points, clouds.points)
    assert len(out) == 4
    assert sorted([*kept, *out]) == list(range(20))
    assert kept == sorted(kept)
    assert out == sorted(out)
    assert torch.equal(held_out.labels, clouds.labels[out])
    # The stream of random numbers stays, so that old runs can be repeated.
    drawn = torch.randperm(20, generator=generator(5, 2))[:4]
    assert out == sorted(drawn.tolist())


def test_split_of_no_share_holds_out_nothing():
    train, held_out = split(small_dataset(train=20).train, 0.0, seed=5)

    assert len(train.points) == 20
    assert len(held_out.points) == 0


def test_split_holds_out_whole_sources():
    clouds = small_dataset(train=20).train
    clouds = clouds._replace(sources=torch.arange(5).repeat_interleave(4))

    _, held_out = split(clouds, 0.4, seed=5)

    assert held_out.sources is not None
    _, counts = held_out.sources.unique(return_counts=True)
    assert counts.tolist() == [4, 4]
