from dataclasses import replace
from typing import Any

import pytest
import torch

from mops_lightning import RandomSampler
from mops_lightning.config.compose import compose
from mops_lightning.data.corruptions import corrupt
from mops_lightning.errors import UserError
from mops_lightning.samplers.critical_points import CriticalSampler
from mops_lightning.training.recipe.recipe import Recipe
from mops_lightning.training.run.make_experiment import make_experiment
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


def test_factory_baseline_returns_the_largest_tested_size():
    made = experiment("sampler=fmops", "sampler.m_max=16", "sizes=[4,16]")

    assert made.sizes == (4, 8, 16)
    assert made.baselines["random"].m == 16


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


def test_factory_passes_the_settings_of_the_run_on():
    given = ["learn=joint", "seed=7", "task_lr_scale=0.5", "sampler=fmops", "sampler.m_max=16"]
    identity = {"m": "8"}

    made = make_experiment(compose([*given, "m=8", "sizes=[4]"]), small_dataset(), identity)

    assert (made.learn, made.seed, made.task_lr_scale) == ("joint", 7, 0.5)
    assert (made.m, made.sizes) == (8, (4, 8))
    assert made.identity is identity
    assert made.test_logger is False
    assert made.recipe.task_points is None


def test_factory_counts_the_points_of_the_smallest_cloud_of_both_splits():
    dataset = small_dataset()
    sizes = torch.full((len(dataset.train.labels),), 48)
    sizes[5] = 6
    data = replace(dataset, train=dataset.train._replace(sizes=sizes))

    with pytest.raises(UserError, match="at most the 6 points of a cloud, got 8"):
        make_experiment(compose(["sampler=fps", "m=8"]), data, {})


def test_factory_keeps_the_points_of_a_task_net_that_is_trained_alone():
    assert experiment("recipe.task_points=20", "learn=task").recipe == Recipe(task_points=20)
