import pytest
import torch

from mops_lightning import FPSSampler, MOPSNet, RandomSampler
from mops_lightning.data.loader import CloudLoader
from mops_lightning.errors import UserError
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.tasks.classification import Classification
from mops_lightning.training.experiment import Experiment
from tests.support.training import quiet_trainer, small_dataset


def experiment(learn="sampler", sampler=True, **extra):
    torch.manual_seed(0)
    if sampler is True:
        sampler = MOPSNet(8, feature_channels=(8, 8), rho_channels=(16, 8))
    return Experiment(
        Classification(PointNetVanilla(3), 3),
        sampler,
        learn=learn,
        make_optimizer=lambda parameters: torch.optim.Adam(parameters, lr=1e-2),
        baselines={"random": RandomSampler(8), "fps": FPSSampler(8)},
        **extra,
    )


@pytest.mark.parametrize(("learn", "rates"), [("joint", [1e-2, 1e-3]), ("sampler", [1e-2])])
def test_task_lr_scale_joint_scales_task_rate(learn, rates):
    module = experiment(learn, task_lr_scale=0.1)
    data = small_dataset()

    quiet_trainer(1).fit(module, CloudLoader(data.train, 6), CloudLoader(data.test, 6))

    groups = module.optimizers().param_groups
    assert [group["lr"] for group in groups] == pytest.approx(rates)
    learned = [module.sampler, module.task] if learn == "joint" else [module.sampler]
    for group, part in zip(groups, learned, strict=True):
        assert ids(group["params"]) == ids(part.parameters())


def ids(parameters):
    return {id(parameter) for parameter in parameters}


def test_train_frozen_parts_stay_in_evaluation_mode():
    module = experiment("sampler").train()

    assert not any(m.training for m in module.task.modules())
    assert module.sampler.training
    assert not any(p.requires_grad for p in module.task.parameters())
    assert experiment("joint").train().task.training


def test_learn_without_sampler_or_optimizer_raises():
    with pytest.raises(UserError, match="needs a sampler"):
        experiment("joint", sampler=None)
    module = Experiment(Classification(PointNetVanilla(3), 3), FPSSampler(8), "nothing")
    with pytest.raises(UserError, match="built without an optimizer"):
        module.configure_optimizers()
