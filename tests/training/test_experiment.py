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


@pytest.mark.parametrize(
    ("learn", "rates"),
    [
        ("joint", {"sampler": 1e-2, "task": 1e-3}),
        ("sampler", {"sampler": 1e-2}),
        ("task", {"task": 1e-2}),
    ],
)
def test_task_lr_scale_joint_scales_task_rate(learn, rates):
    module = experiment(learn, task_lr_scale=0.1)
    data = small_dataset()
    train = CloudLoader(data.train, 6)
    val = CloudLoader(data.test, 6)

    quiet_trainer(1, limit_train_batches=1).fit(module, train, val)

    groups = module.optimizers().param_groups
    assert {group["name"]: group["lr"] for group in groups} == pytest.approx(rates)
    for group in groups:
        learned = module.get_submodule(group["name"])
        assert ids(group["params"]) == ids(learned.parameters())


def ids(parameters):
    return {id(parameter) for parameter in parameters}


def test_train_frozen_parts_stay_in_evaluation_mode():
    module = experiment("sampler").train()
    joint = experiment("joint").train()

    assert module.sampler.training
    for part in module.task.modules():
        assert not part.training
    for parameter in module.task.parameters():
        assert not parameter.requires_grad
    assert joint.task.training


def test_learn_without_sampler_or_optimizer_raises():
    with pytest.raises(UserError, match="needs a sampler"):
        experiment("joint", sampler=None)
    module = Experiment(Classification(PointNetVanilla(3), 3), FPSSampler(8), "nothing")
    with pytest.raises(UserError, match="built without an optimizer"):
        module.configure_optimizers()
