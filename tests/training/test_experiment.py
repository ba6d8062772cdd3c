import pytest
import torch

from mops_lightning.data.loader import CloudLoader
from mops_lightning.errors import UserError
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.samplers.random import RandomSampler
from mops_lightning.tasks.classification import Classification
from mops_lightning.training.experiment import Experiment
from tests.support.training import changed, quiet_trainer, small_dataset, state


def experiment(learn="sampler", sampler=True, **extra):
    torch.manual_seed(0)
    net = MOPSNet(8, feature_channels=(8, 8), rho_channels=(16, 8)) if sampler is True else sampler
    return Experiment(
        Classification(PointNetVanilla(3), 3),
        net,
        learn=learn,
        make_optimizer=lambda parameters: torch.optim.Adam(parameters, lr=1e-2),
        baselines={"random": RandomSampler(8), "fps": FPSSampler(8)},
        **extra,
    )


def fit(module, epochs=2):
    data = small_dataset()
    quiet_trainer(epochs).fit(
        module,
        CloudLoader(data.train, 6, shuffle=True, drop_last=True),
        CloudLoader(data.test, 6),
    )
    return module


def test_fit_learn_sampler_leaves_task_unchanged():
    module = experiment("sampler")
    before = state(module)
    names = changed(before, fit(module))
    assert names
    # Running statistics are part of the state, so BatchNorm drift would show here.
    assert all(name.startswith("sampler.") for name in names)
    assert {"sampler.queries.weight", "sampler.rho_first.0.running_mean"} <= names


@pytest.mark.parametrize(("learn", "rates"), [("joint", [1e-2, 1e-3]), ("sampler", [1e-2])])
def test_task_lr_scale_joint_scales_task_rate(learn, rates):
    module = fit(experiment(learn, task_lr_scale=0.1), epochs=1)
    groups = module.optimizers().param_groups
    assert [group["lr"] for group in groups] == pytest.approx(rates)
    parts = (module.sampler, module.task)[: len(rates)]
    for group, part in zip(groups, parts, strict=True):
        assert {id(p) for p in group["params"]} == {id(p) for p in part.parameters()}


def test_fit_learn_joint_changes_both():
    module = experiment("joint")
    before = state(module)
    names = changed(before, fit(module))
    assert any(name.startswith("sampler.") for name in names)
    assert {"task.net.pool.linear.weight", "task.net.pool.norm.running_var"} <= names


def test_train_frozen_parts_stay_in_evaluation_mode():
    module = experiment("sampler").train()
    assert not any(m.training for m in module.task.modules())
    assert module.sampler.training
    assert not any(p.requires_grad for p in module.task.parameters())


def test_test_refine_adds_readout():
    data = small_dataset()
    run = quiet_trainer(2)
    module = experiment(refine=1)
    run.test(module, CloudLoader(data.test, 4), verbose=False)
    assert "test/refined/accuracy" in run.callback_metrics
    assert module.score_name == "test/generated/accuracy"


def test_experiment_without_optimizer_only_tests():
    module = Experiment(Classification(PointNetVanilla(3), 3), FPSSampler(8), "nothing")
    with pytest.raises(UserError, match="built without an optimizer"):
        module.configure_optimizers()


def test_learn_unknown_or_without_sampler_raises():
    with pytest.raises(UserError, match="Did you mean 'sampler'"):
        experiment("samplr")
    with pytest.raises(UserError, match="needs a sampler"):
        experiment("joint", sampler=None)
