from dataclasses import replace

import torch

from mops_lightning.config.compose import compose
from mops_lightning.data.pairs import Pairs
from mops_lightning.losses.registration import quaternion_loss
from mops_lightning.nets.icp import ICP
from mops_lightning.seeding import generator
from mops_lightning.tasks.registration import Registration
from mops_lightning.training.run.loaders import (
    augmentation,
    clouds_to_draw,
    held_out_mask,
    score_loader,
    split,
)
from tests.support.training import small_dataset


def rows(part, whole):
    """Rows of a part's clouds in the whole split."""
    return [int((whole == cloud).all(2).all(1).nonzero()) for cloud in part]


def test_split_holds_out_fraction_in_order():
    clouds = small_dataset(train=20).train
    train, held_out = split(clouds, 0.2, seed=5)
    kept, out = rows(train.points, clouds.points), rows(held_out.points, clouds.points)
    assert len(out) == held_out_mask(clouds, 0.2, 0).sum() == 4
    assert sorted([*kept, *out]) == list(range(20))
    assert (kept, out) == (sorted(kept), sorted(out))
    assert torch.equal(held_out.labels, clouds.labels[out])
    # The stream of random numbers stays, so that old runs can be repeated.
    assert out == sorted(torch.randperm(20, generator=generator(5, 2))[:4].tolist())


def test_split_other_seed_holds_out_others():
    clouds = small_dataset(train=20).train
    first, again, other = (split(clouds, 0.2, seed)[1].points for seed in (5, 5, 6))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_split_zero_fraction_holds_out_nothing():
    train, held_out = split(small_dataset(train=20).train, 0.0, seed=5)
    assert (len(train.points), len(held_out.points)) == (20, 0)


def test_clouds_to_draw_spreads_over_classes():
    dataset = small_dataset()
    chosen, names = clouds_to_draw(dataset, 2)
    assert names == ["long", "round"]
    assert dataset.test.labels[chosen].tolist() == [0, 2]
    assert chosen.tolist() == [0, 2]  # the first of each class
    assert clouds_to_draw(dataset, 9)[1] == ["long", "tall", "round"]
    assert clouds_to_draw(dataset, 1)[1] == ["long"]
    assert clouds_to_draw(dataset, 0)[1] == []


def test_split_holds_out_whole_sources():
    clouds = small_dataset(train=20).train
    clouds = clouds._replace(sources=torch.arange(5).repeat_interleave(4))
    mask = held_out_mask(clouds, 0.4, seed=5)
    assert mask.view(5, 4).sum(1).sort().values.tolist() == [0, 0, 0, 4, 4]
    assert len(split(clouds, 0.4, seed=5)[1].points) == 8


def test_clouds_to_draw_leaves_out_classes_without_test_clouds():
    dataset = small_dataset()
    test = dataset.test.take(dataset.test.labels != 0)
    chosen, names = clouds_to_draw(replace(dataset, test=test), 3)
    assert names == ["tall", "round"]
    assert test.labels[chosen].tolist() == [1, 2]


def test_score_loader_repeats_its_pairs_in_every_epoch():
    clouds = small_dataset().test
    task = Registration(ICP(), Pairs(), quaternion_loss)
    first = score_loader(clouds, 4, task)
    epochs = [[batch.points for batch in first] for _ in range(2)]
    assert [len(points) for points in epochs[0]] == [8, 8, 4]  # sources and targets
    for one, again in zip(*epochs, strict=True):
        assert torch.equal(one, again)
    shares = [list(score_loader(clouds, 4, task, (rank, 2))) for rank in range(2)]
    assert [sum(batch.num_clouds for batch in share) for share in shares] == [5, 5]


def test_augmentation_of_joint_training_is_that_of_the_sampler():
    changed = ["augment.task.jitter=0.01", "augment.sampler.jitter=0.02"]
    found = {
        learn: augmentation(compose([*changed, f"learn={learn}"])).jitter
        for learn in ("task", "sampler", "joint")
    }
    assert found == {"task": 0.01, "sampler": 0.02, "joint": 0.02}
