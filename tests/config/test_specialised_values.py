"""Values in files of groups that are no defaults of a class: published ones, and chosen ones.

``test_defaults`` compares the other values with the defaults of the classes.
"""

from typing import Any

from omegaconf import DictConfig, OmegaConf

from mops_lightning.tree import dotted
from tests.config.test_defaults import CONF, DIFFERENT, FILES

GROUPS = (
    "dataset_task",
    "optimizer",
    "recipe",
    "sampler",
    "sampler_recipe",
    "task",
    "task_settings",
)

VALUES = """
dataset_task/clouds_reconstruction: epochs.task=100 epochs.sampler=30
dataset_task/mesh_sequence_registration: epochs.task=40
dataset_task/meshes_classification: epochs.task=20
dataset_task/meshes_registration: epochs.task=40
dataset_task/scans_of_shapes_classification: epochs.task=12 epochs.sampler=10
dataset_task/scans_of_shapes_reconstruction: epochs.task=60 epochs.sampler=10
dataset_task/scans_of_shapes_segmentation: dataset.classes=parts
dataset_task/scans_of_shapes_segmentation: epochs.task=30 epochs.sampler=10 pretrain.lr=0.004
dataset_task/shapenet_core_reconstruction: epochs.task=100 epochs.sampler=30
dataset_task/shapes_classification: epochs.task=12 epochs.sampler=10
dataset_task/shapes_reconstruction: epochs.task=60 epochs.sampler=10
dataset_task/shapes_registration: weights=auto pretrain_from=pcrnet.modelnet40 pretrain.lr=0.0005
dataset_task/shapes_registration: val_fraction=0.0125 epochs.task=6 epochs.sampler=6
dataset_task/shapes_registration: recipe.train_points=256 recipe.task_points=128
dataset_task/shapes_registration: dataset.classes=asymmetric
dataset_task/shapes_registration: dataset.train_per_class=640 dataset.test_per_class=40
dataset_task/shapes_segmentation: dataset.classes=parts
dataset_task/shapes_segmentation: epochs.task=30 epochs.sampler=10 pretrain.lr=0.004
optimizer/exponential: _target_=torch.optim.Adam lr=0.0005 schedule.end_lr=1e-05
optimizer/exponential: schedule._target_=mops_lightning.training.schedules.exponential
optimizer/exponential/registration: lr=0.0001
optimizer/muon: lr=0.002 schedule.warmup=0.3
optimizer/muon: schedule._target_=mops_lightning.training.schedules.one_cycle
optimizer/one_cycle: _target_=torch.optim.Adam lr=0.001 schedule.warmup=0.3
optimizer/one_cycle: schedule._target_=mops_lightning.training.schedules.one_cycle
optimizer/one_cycle_fmops/registration_fast: lr=0.005
optimizer/one_cycle_snet/classification: lr=0.01
optimizer/one_cycle_snet/reconstruction: lr=0.0005
optimizer/step_decay: _target_=torch.optim.Adam lr=0.001
optimizer/step_decay: schedule._target_=mops_lightning.training.schedules.step_decay
optimizer/step_decay: schedule.every=6250 schedule.factor=0.7 schedule.floor_lr=1e-05
optimizer/step_decay_snet: lr=0.01 schedule.every=18750
recipe/fast: train_points=256 warm_start=True distillation=3.0 ema_span=0.2
recipe/fast/classification: task_points=256
recipe/fast/reconstruction: distillation=0.0
recipe/fast/registration: train_points=512 distillation=0.0 feature_distillation=1.0
sampler/fmops/classification_fast: min_size=8
sampler/fmops/classification_paper: size_sampling=uniform
sampler/fmops/reconstruction_paper: size_sampling=uniform
sampler/fmops/registration_fast: m_max=64 anchors=framed anchor_width=2.0 min_size=8 num_sizes=2
sampler/fmops/registration_fast: rho_channels=[256,128]
sampler/fmops/registration_paper: m_max=64 size_sampling=uniform
sampler/mops/reconstruction: alpha=0.2 tau_min=0.5
sampler/mops/registration: alpha=1.0
sampler/samplenet/reconstruction: k=16 beta=0.0001 sigma_min=0.0001
sampler/samplenet/registration: k=8 beta=0.01 sigma_min=0.01
sampler/samplenet_progressive: coverage=0.5 coverage_per_point=0.03333333333333333
sampler/samplenet_progressive/reconstruction: min_size=16 size_reduction=mean
sampler/samplenet_progressive/registration: size_reduction=mean
sampler/samplenet_progressive/registration: coverage=1.0 coverage_per_point=0.0
sampler/snet/reconstruction: alpha=0.01 coverage=0.0 coverage_per_point=0.015625
sampler/snet/reconstruction: feature_channels=[64,128,128,256,128] head_channels=[256,256]
sampler/snet/reconstruction: head_norm=False output_norm=False
sampler/snet/registration: alpha=0.01 output_norm=False
sampler_recipe/registration_fast_fmops: feature_distillation=0.0
task/net/foldingnet: pieces=1
task/net/hierarchical: sampler._partial_=True
task/net/hierarchical_segmentation: sampler._partial_=True
task/net/pcrnet/shapes: iterations=2
task_settings/classification: augment.task.rotate_up=True augment.task.jitter=0.01
task_settings/classification: augment.task.stretch=1.0 augment.task.shift=0.0
task_settings/reconstruction: epochs.task=200 epochs.sampler=60
task_settings/registration: task_lr_scale=0.1
"""


def values_written_here() -> dict[str, set[str]]:
    values: dict[str, set[str]] = {}
    for line in VALUES.strip().splitlines():
        file, settings = line.split(": ")
        values.setdefault(file, set()).update(settings.split())
    return values


def values_of(file: str, content: DictConfig) -> set[str]:
    """Return the values of a file that are neither references nor defaults of its class."""
    plain: Any = OmegaConf.to_container(content)
    plain.pop("defaults", None)
    values = set()
    for name, value in dotted(plain).items():
        of_class = file in FILES and "." not in name and name not in DIFFERENT.get(file, set())
        is_reference = isinstance(value, str) and value.startswith(("${", "???"))
        if not of_class and not is_reference:
            text = str(value).replace(" ", "")
            values.add(f"{name}={text}")
    return values


def test_values_that_are_no_defaults_of_a_class_are_these():
    found = {}
    for group in GROUPS:
        for path in CONF.joinpath(group).rglob("*.yaml"):
            content = OmegaConf.load(path)
            assert isinstance(content, DictConfig)
            relative = path.relative_to(CONF)
            values = values_of(relative.as_posix(), content)
            if values:
                found[relative.with_suffix("").as_posix()] = values

    assert found == values_written_here()
