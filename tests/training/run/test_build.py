from dataclasses import replace
from typing import Any

import pytest
import torch

from mops_lightning import FMOPSNet, FPSSampler, MOPSNet, RandomSampler
from mops_lightning.config.compose import compose
from mops_lightning.data.corruptions import corrupt
from mops_lightning.errors import UserError
from mops_lightning.samplers.critical_points import CriticalSampler
from mops_lightning.seeding import generator
from mops_lightning.training.recipe.recipe import Recipe
from mops_lightning.training.run.build import augmentation, make_experiment, sizes_to_test, split
from tests.support.training import small_dataset

BASELINE = "+baselines.critical._target_=mops_lightning.samplers.critical_points.CriticalSampler"


def test_factory_gives_task_net_to_samplers_that_need_it():
    for overrides in (["sampler=critical", "sizes=[4,16]"], ["m=16", BASELINE]):
        made: Any = make_experiment(compose([*overrides, "m=8"]), small_dataset(), {})
        sampler = made.baselines["critical"] if len(made.baselines) else made.sampler
        assert isinstance(sampler, CriticalSampler)
        assert sampler._net == (made.task.net,)
        assert not any(name.startswith(("sampler.net", "baselines")) for name in made.state_dict())


def test_factory_first_weights_of_sampler_depend_on_seed_and_not_on_task_net():
    def first(*overrides):
        made: Any = make_experiment(compose([*overrides, "m=8"]), small_dataset(), {})
        return next(made.sampler.parameters())

    assert torch.equal(first(), first("task/net=dgcnn"))
    assert not torch.equal(first(), first("seed=1"))


def test_factory_baseline_has_the_seed_of_the_run_or_its_own():
    points = small_dataset().test.points[:2]
    for seed in ("seed=3", "+baselines.random.seed=3"):
        made: Any = make_experiment(compose([seed, "m=8"]), small_dataset(), {})
        chosen = made.baselines["random"](points).points
        assert torch.equal(chosen, RandomSampler(8, seed=3)(points).points)


def test_factory_refuses_start_of_a_baseline_outside_of_the_clouds():
    cfg = compose(["+baselines.fps.start=5000", "m=8"])  # not only when a trained run is tested
    with pytest.raises(UserError, match=r"baselines\.fps: start must be less than .* N=48"):
        make_experiment(cfg, small_dataset(), {})


@pytest.mark.parametrize("learn", ["task", "sampler"])
def test_factory_recipe_without_its_settings_is_that_of_the_publication(learn):
    recipe = compose().recipe.items()
    # Hydra deletes no key that is null.
    named = [name for name, value in recipe if value is not None and name != "_target_"]
    assert len(named) > 3
    cfg = compose([*(f"~recipe.{name}" for name in named), f"learn={learn}", "m=8"])
    assert make_experiment(cfg, small_dataset(), {}).recipe == Recipe()


@pytest.mark.parametrize("learn", ["joint", "sampler"])
def test_factory_recipe_of_index_sampler_serves_a_task_net_that_learns(learn):
    given = ["recipe.train_points=20", "recipe.ema_span=0.3", f"learn={learn}", "sampler=fps"]
    made = make_experiment(compose([*given, "m=8"]), small_dataset(), {})
    expected = Recipe(train_points=20, ema_span=0.3) if learn == "joint" else Recipe()
    assert made.recipe == expected


def test_factory_segmentation_needs_data_with_parts(capsys):
    cfg = compose(["task=segmentation", "m=8", "task.net.points=[16,8]"])
    made: Any = make_experiment(cfg, small_dataset(), {})
    assert made.task.num_parts == made.task.net.head[-1].out_features == 2
    with pytest.raises(UserError, match=r"2 to 1000 parts, got none\. .* dataset\.label=COLUMN"):
        make_experiment(cfg, replace(small_dataset(), part_names=()), {})
    data: Any = small_dataset()
    with pytest.raises(UserError, match="2 to 1000 parts, got 1001"):
        make_experiment(cfg, replace(data, part_names=("",) * 1001), {})
    unknown = data.test._replace(parts=torch.full_like(data.test.parts, -1))
    with pytest.raises(UserError, match="no test point has a known part"):
        make_experiment(cfg, replace(data, test=unknown), {})
    make_experiment(cfg, replace(data, test=unknown._replace(parts=unknown.parts + 1)), {})
    assert f"no test point of part {data.part_names[1]}" in capsys.readouterr().err
    assert corrupt(data.test, "shear-1").parts is data.test.parts
    cfg = compose(["task=segmentation", "m=8", "test_corruption=cutout-1"])
    with pytest.raises(UserError, match=r"test_corruption=cutout-1 adds or removes points"):
        make_experiment(cfg, replace(data, test=corrupt(data.test, "cutout-1")), {})
    of_parts = "hierarchical_segmentation"
    for task, net in (("segmentation", "pointnet"), ("classification", of_parts)):
        with pytest.raises(UserError, match=rf"task/net={net} takes .*, but task={task} gives"):
            make_experiment(compose([f"task={task}", f"task/net={net}"]), data, {})


def rows(part, whole):
    """Rows of a part's clouds in the whole split."""
    return [int((whole == cloud).all(2).all(1).nonzero()) for cloud in part]


def test_split_holds_out_fraction_in_order():
    clouds = small_dataset(train=20).train
    train, held_out = split(clouds, 0.2, seed=5)
    kept, out = rows(train.points, clouds.points), rows(held_out.points, clouds.points)
    assert len(out) == 4
    assert sorted([*kept, *out]) == list(range(20))
    assert (kept, out) == (sorted(kept), sorted(out))
    assert torch.equal(held_out.labels, clouds.labels[out])
    # The stream of random numbers stays, so that old runs can be repeated.
    assert out == sorted(torch.randperm(20, generator=generator(5, 2))[:4].tolist())
    assert [len(part.points) for part in split(clouds, 0.0, seed=5)] == [20, 0]


def test_split_holds_out_whole_sources():
    clouds = small_dataset(train=20).train
    clouds = clouds._replace(sources=torch.arange(5).repeat_interleave(4))
    sources = split(clouds, 0.4, seed=5)[1].sources
    assert sources is not None
    assert sources.unique(return_counts=True)[1].tolist() == [4, 4]


def test_augmentation_of_joint_training_is_that_of_the_sampler():
    changed = ["augment.task.jitter=0.01", "+augment.sampler.jitter=0.02"]
    found = {
        learn: augmentation(compose([*changed, f"learn={learn}"])).jitter
        for learn in ("task", "sampler", "joint")
    }
    assert found == {"task": 0.01, "sampler": 0.02, "joint": 0.02}


@pytest.mark.parametrize(
    ("sizes", "m", "sampler", "expected"),
    [
        ("auto", 32, FMOPSNet(512), (8, 16, 32, 64, 128, 256, 512)),
        ("auto", 20, FMOPSNet(100), (8, 16, 20, 32, 64)),
        ("auto", 32, MOPSNet(32), (32,)),
        ("auto", 32, FPSSampler(32), (32,)),
        ([64, 8], 32, FPSSampler(32), (8, 32, 64)),
        ([64, 8, 8], 8, FMOPSNet(100), (8, 64)),
        ([32], 32, MOPSNet(32), (32,)),
        ("auto", 32, None, ()),
    ],
)
def test_sizes_to_test_returns_ascending_sizes(sizes, m, sampler, expected):
    assert sizes_to_test(sizes, m, sampler, 1024) == expected


@pytest.mark.parametrize(
    ("sizes", "m", "sampler", "named"),
    [
        ([8], 32, MOPSNet(32), r"returns 32 points.*got sizes=\[8\]"),
        ([101], 32, FMOPSNet(100), "sizes must be at most sampler.m_max=100, got 101"),
        ([201], 32, FPSSampler(32), "sizes must be at most the 200 points of a cloud, got 201"),
        ("auto", 101, FMOPSNet(100), "m must be at most sampler.m_max=100, got 101"),
        ("auto", 32, FMOPSNet(512), "sampler.m_max must be at most the 200 points .* got 512"),
    ],
)
def test_sizes_to_test_out_of_range_raises(sizes, m, sampler, named):
    with pytest.raises(UserError, match=named):
        sizes_to_test(sizes, m, sampler, 200)
