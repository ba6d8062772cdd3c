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
    own = experiment("sampler=critical", "sizes=[4,16]")
    with_baseline = experiment(BASELINE)

    assert_holds_net(own.sampler, own)
    assert_holds_net(with_baseline.baselines["critical"], with_baseline)


def experiment(*overrides: str) -> Any:
    return make_experiment(compose([*overrides, "m=8"]), small_dataset(), {})


def assert_holds_net(sampler, made):
    """Assert that a sampler uses the task net without owning its weights."""
    assert isinstance(sampler, CriticalSampler)
    assert sampler._net == (made.task.net,)
    assert not any(name.startswith(("sampler.net", "baselines")) for name in made.state_dict())


def test_factory_first_weights_of_sampler_depend_on_seed_and_not_on_task_net():
    def first(*overrides):
        return next(experiment(*overrides).sampler.parameters())

    assert torch.equal(first(), first("task/net=dgcnn"))
    assert not torch.equal(first(), first("seed=1"))


def test_factory_baseline_has_the_seed_of_the_run_or_its_own():
    points = small_dataset().test.points[:2]
    expected = RandomSampler(8, seed=3)(points).points

    for seed in ("seed=3", "+baselines.random.seed=3"):
        baseline = experiment(seed).baselines["random"]
        assert torch.equal(baseline(points).points, expected)


def test_factory_refuses_start_of_a_baseline_outside_of_the_clouds():
    cfg = compose(["+baselines.fps.start=5000", "m=8"])  # not only when a trained run is tested
    with pytest.raises(UserError, match=r"baselines\.fps: start must be less than .* N=48"):
        make_experiment(cfg, small_dataset(), {})


@pytest.mark.parametrize("learn", ["task", "sampler"])
def test_factory_recipe_without_its_settings_is_that_of_the_publication(learn):
    removals = []
    for name, value in compose().recipe.items():
        if value is not None and name != "_target_":  # Hydra deletes no key that is null
            removals.append(f"~recipe.{name}")
    assert len(removals) > 3

    made = experiment(*removals, f"learn={learn}")

    assert made.recipe == Recipe()


@pytest.mark.parametrize(
    ("learn", "expected"),
    [
        ("joint", Recipe(train_points=20, ema_span=0.3)),
        ("sampler", Recipe()),
    ],
)
def test_factory_recipe_of_index_sampler_serves_a_task_net_that_learns(learn, expected):
    given = ["recipe.train_points=20", "recipe.ema_span=0.3", f"learn={learn}", "sampler=fps"]

    assert experiment(*given).recipe == expected


SEGMENTATION = ["task=segmentation", "m=8"]


def test_factory_segmentation_has_the_parts_of_the_data():
    made = experiment(*SEGMENTATION, "task.net.points=[16,8]")

    assert made.task.num_parts == 2
    assert made.task.net.head[-1].out_features == 2


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ((), r"2 to 1000 parts, got none\. .* dataset\.label=COLUMN"),
        (("",) * 1001, "2 to 1000 parts, got 1001"),
    ],
)
def test_factory_segmentation_refuses_data_of_no_or_too_many_parts(names, said):
    data = replace(small_dataset(), part_names=names)

    with pytest.raises(UserError, match=said):
        make_experiment(compose(SEGMENTATION), data, {})


def test_factory_segmentation_refuses_test_points_of_no_known_part(capsys):
    cfg = compose([*SEGMENTATION, "task.net.points=[16,8]"])
    data: Any = small_dataset()
    unknown = torch.full_like(data.test.parts, -1)

    with pytest.raises(UserError, match="no test point has a known part"):
        make_experiment(cfg, replace(data, test=data.test._replace(parts=unknown)), {})

    first_part = unknown + 1
    make_experiment(cfg, replace(data, test=data.test._replace(parts=first_part)), {})
    assert f"no test point of part {data.part_names[1]}" in capsys.readouterr().err


def test_factory_segmentation_refuses_corruptions_that_change_the_number_of_points():
    data: Any = small_dataset()
    assert corrupt(data.test, "shear-1").parts is data.test.parts
    cfg = compose([*SEGMENTATION, "test_corruption=cutout-1"])

    with pytest.raises(UserError, match=r"test_corruption=cutout-1 adds or removes points"):
        make_experiment(cfg, replace(data, test=corrupt(data.test, "cutout-1")), {})


@pytest.mark.parametrize(
    ("task", "net"),
    [
        ("segmentation", "pointnet"),
        ("classification", "hierarchical_segmentation"),
    ],
)
def test_factory_refuses_net_of_another_task(task, net):
    cfg = compose([f"task={task}", f"task/net={net}"])

    with pytest.raises(UserError, match=rf"task/net={net} takes .*, but task={task} gives"):
        make_experiment(cfg, small_dataset(), {})


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


def test_augmentation_of_joint_training_is_that_of_the_sampler():
    changed = ["augment.task.jitter=0.01", "+augment.sampler.jitter=0.02"]

    jitter = {}
    for learn in ("task", "sampler", "joint"):
        cfg = compose([*changed, f"learn={learn}"])
        jitter[learn] = augmentation(cfg).jitter

    assert jitter == {"task": 0.01, "sampler": 0.02, "joint": 0.02}


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
