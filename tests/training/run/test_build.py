from typing import Any

import pytest
import torch

from mops_lightning.config.compose import compose
from mops_lightning.errors import UserError
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.samplers.submodular import SubmodularSampler
from mops_lightning.training.recipe.recipe import Recipe
from mops_lightning.training.run.build import make_experiment
from tests.support.training import small_dataset

BASELINE = "+baselines.submodular._target_=mops_lightning.samplers.submodular.SubmodularSampler"


def test_factory_gives_task_net_to_samplers_that_need_it():
    for overrides in (["sampler=submodular", "sizes=[4,16]"], ["m=16", BASELINE]):
        made: Any = make_experiment(compose([*overrides, "m=8"]), small_dataset(), {})
        sampler = made.baselines["submodular"] if len(made.baselines) else made.sampler
        assert isinstance(sampler, SubmodularSampler)
        assert sampler.net is made.task.net
        assert not any(name.startswith(("sampler.net", "baselines")) for name in made.state_dict())


def test_factory_net_without_point_features_raises():
    cfg = compose(["sampler=critical", "task=registration", "task/net=icp", "m=8"])
    with pytest.raises(UserError, match=r"net must have features of single points.*got ICP"):
        make_experiment(cfg, small_dataset(), {})


@pytest.mark.parametrize(
    ("overrides", "setting"),
    [
        (["sampler=fps", "sampler.start=5000"], "sampler.start"),
        (["sampler=mops", "+baselines.fps.start=5000"], "baselines.fps.start"),
    ],
)
def test_factory_sampler_that_the_clouds_rule_out_raises_before_training(overrides, setting):
    with pytest.raises(UserError, match=rf"^{setting} must be less than .* N=\d+, got 5000"):
        make_experiment(compose([*overrides, "m=8"]), small_dataset(), {})


def test_factory_counts_the_points_that_pairs_draw():
    overrides = ["task=registration", "sampler=fps", "m=8", "task.pairs.resample=16"]
    make_experiment(compose([*overrides, "sampler.start=15"]), small_dataset(), {})
    with pytest.raises(UserError, match=r"^sampler.start must be less than .* N=16, got 16"):
        make_experiment(compose([*overrides, "sampler.start=16"]), small_dataset(), {})


@pytest.mark.parametrize("learn", ["task", "sampler"])
def test_factory_recipe_without_a_setting_is_that_of_the_publication(learn):
    recipe = compose().recipe.items()
    named = [name for name, value in recipe if value is not None and name != "_target_"]
    for name in named:  # Hydra deletes no key that is null
        cfg = compose([f"~recipe.{name}", f"learn={learn}", "m=8"])
        made = make_experiment(cfg, small_dataset(), {})
        assert getattr(made.recipe, name) == getattr(Recipe(), name)


def test_factory_sampler_sees_weights_loaded_later(rng):
    points = torch.randn(2, 48, 3, generator=rng)
    made = make_experiment(compose(["sampler=critical", "m=8"]), small_dataset(), {})
    assert made.sampler is not None
    before = made.sampler(points).indices
    torch.manual_seed(9)
    made.task.net.load_state_dict(PointNetVanilla(3).state_dict())
    assert not torch.equal(made.sampler(points).indices, before)
