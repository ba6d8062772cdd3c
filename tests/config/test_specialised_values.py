"""What files of groups choose, and their values that are no defaults of a class.

``test_defaults`` compares the other values with the defaults of the classes.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from mops_lightning.tree import dotted
from tests.config.test_defaults import CONF, DIFFERENT, FILES

GROUPS = (
    "baselines",
    "callbacks",
    "dataset",
    "dataset_task",
    "debug",
    "experiment",
    "logger",
    "optimizer",
    "recipe",
    "sampler",
    "sampler_recipe",
    "task",
    "task_settings",
    "trainer",
)

VALUES = """
baselines/default: choice0=optionaldefault@_here_:${task} choice1=_self_
baselines/default: fps._target_=samplers.fps.FPSSampler
baselines/default/classification: random._target_=samplers.random.RandomSampler
baselines/default/classification: voxel._target_=samplers.voxel.VoxelSampler
baselines/default/reconstruction: choice0=classification
baselines/default/registration: fps_farthest._target_=samplers.fps.FPSSampler
baselines/default/registration: fps_farthest.start=farthest
baselines/default/segmentation: choice0=classification
callbacks/default: learning_rate._target_=lightning.pytorch.callbacks.LearningRateMonitor
callbacks/default: checkpoint._target_=training.run.callbacks.last_checkpoint
callbacks/default: progress._target_=training.run.callbacks.progress
callbacks/default: pictures._target_=training.run.pictures.CloudVisualization pictures.up=y
callbacks/default: pictures.colour=None
config: choice0=run_settings choice1=optimizer:one_cycle choice2=optimizer@pretrain:one_cycle
config: choice3=sampler:mops choice4=recipe:fast choice5=baselines:default choice6=trainer:auto
config: choice7=callbacks:default choice8=logger:tensorboard choice9=task:classification
config: choice10=dataset:shapes choice11=_self_
config: choice12=optionalsampler_recipe@recipe:${task}_${recipe}_${sampler}
config: choice13=optionaltask_settings@_global_:${task}
config: choice14=optionaldataset_task@_global_:${dataset}_${task} choice15=experiment:None
config: choice16=debug:None choice17=overridehydra/help:mops epochs.task=30 epochs.sampler=8
config: epochs.nothing=0 augment.task=None augment.sampler=None
config: hydra.callbacks.start._target_=cli.start.RunStart
config: hydra.callbacks.summary._target_=cli.sweep_end.SweepSummary
config: hydra.callbacks.summary.mixed=False hydra.callbacks.summary.models=False
config: hydra.job.name=mops_lightning hydra.job.chdir=False
config: hydra.job.env_set.MLFLOW_ALLOW_FILE_STORE=true
dataset/mesh_sequence: n_points=40960 gap=2
dataset/shapenet_core: test_share=0.15
dataset_task/clouds_reconstruction: epochs.task=100 epochs.sampler=30
dataset_task/mesh_sequence_registration: epochs.task=40
dataset_task/meshes_classification: epochs.task=20
dataset_task/meshes_registration: epochs.task=40
dataset_task/scans_of_shapes_classification: epochs.task=12 epochs.sampler=10
dataset_task/scans_of_shapes_reconstruction: epochs.task=60 epochs.sampler=10
dataset_task/scans_of_shapes_segmentation: dataset.classes=parts epochs.task=30 epochs.sampler=10
dataset_task/scans_of_shapes_segmentation: pretrain.lr=0.004
dataset_task/shapenet_core_reconstruction: epochs.task=100 epochs.sampler=30
dataset_task/shapes_classification: epochs.task=12 epochs.sampler=10
dataset_task/shapes_reconstruction: epochs.task=60 epochs.sampler=10
dataset_task/shapes_registration: weights=auto pretrain_from=pcrnet.modelnet40 pretrain.lr=0.0005
dataset_task/shapes_registration: val_fraction=0.0125 epochs.task=6 epochs.sampler=6
dataset_task/shapes_registration: dataset.classes=asymmetric dataset.train_per_class=640
dataset_task/shapes_registration: dataset.test_per_class=40
dataset_task/shapes_segmentation: dataset.classes=parts epochs.task=30 epochs.sampler=10
dataset_task/shapes_segmentation: pretrain.lr=0.004
debug/fdr: trainer.fast_dev_run=True
debug/overfit: trainer.overfit_batches=2
debug/profiler: trainer.profiler=simple epochs.task=1 epochs.sampler=1 epochs.joint=1
experiment/classification_paper: choice0=override/task:classification
experiment/classification_paper: choice1=override/dataset:modelnet40 choice2=override/sampler:mops
experiment/classification_paper: choice3=override/optimizer:exponential
experiment/classification_paper: choice4=override/recipe:paper
experiment/classification_paper: choice5=override/optimizer@pretrain:step_decay epochs.task=250
experiment/classification_paper: epochs.sampler=250 val_fraction=0.0
experiment/classification_snet: choice0=override/task:classification
experiment/classification_snet: choice1=override/dataset:modelnet40 choice2=override/sampler:snet
experiment/classification_snet: choice3=override/optimizer:step_decay_snet
experiment/classification_snet: choice4=override/recipe:paper
experiment/classification_snet: choice5=override/optimizer@pretrain:step_decay epochs.task=250
experiment/classification_snet: epochs.sampler=500 val_fraction=0.0
experiment/las_segmentation: choice0=override/task:segmentation choice1=override/dataset:clouds
experiment/las_segmentation: choice2=override/sampler:fps dataset.n_points=4096 dataset.crop=tiles
experiment/las_segmentation: dataset.label=classification
experiment/las_segmentation: dataset.features=['intensity','return_number','number_of_returns']
experiment/las_segmentation: learn=joint weights=None m=205 task.net.points=[128,32]
experiment/las_segmentation: recipe.train_points=None augment.task.rotate_up=z
experiment/las_segmentation: augment.sampler.rotate_up=z batch_size=8 val_fraction=0.0
experiment/las_segmentation: epochs.joint=30 optimizer.lr=0.004 callbacks.pictures.up=z
experiment/modelnet40_quick: choice0=override/task:classification
experiment/modelnet40_quick: choice1=override/dataset:modelnet40 choice2=override/sampler:mops
experiment/modelnet40_quick: choice3=override/recipe:fast choice4=override/optimizer:muon m=32
experiment/modelnet40_quick: batch_size=64 val_fraction=0.0 epochs.task=12 epochs.sampler=30
experiment/modelnet40_quick: optimizer.lr=0.002 pretrain.lr=0.002 recipe.task_points=None
experiment/modelnet40_quick: augment.task.rotate_up=False
experiment/own_scans: choice0=override/task:reconstruction choice1=override/dataset:clouds
experiment/own_scans: choice2=override/sampler:fmops m=32 sizes=[8,16,32,128] sampler.m_max=128
experiment/own_scans: sampler.num_sizes=2 sampler.min_size=6 sampler.anchors=fps
experiment/own_scans: sampler.anchor_width=0.8 sampler.feature_channels=[64,128,128,256,128]
experiment/own_scans: recipe.feature_distillation=1.0 recipe.train_points=512
experiment/own_scans: baselines.fps_farthest._target_=samplers.fps.FPSSampler
experiment/own_scans: baselines.fps_farthest.start=farthest augment.task.rotate_up=z batch_size=16
experiment/own_scans: task.exact_up_to=None val_fraction=0.2 trainer.check_val_every_n_epoch=3
experiment/own_scans: callbacks.early_stopping._target_=lightning.pytorch.callbacks.EarlyStopping
experiment/own_scans: callbacks.early_stopping.monitor=val/completed/nre_cd
experiment/own_scans: callbacks.early_stopping.patience=6 callbacks.early_stopping.strict=False
experiment/own_scans: epochs.task=60 epochs.sampler=90
experiment/own_scans_icp: choice0=override/task:icp choice1=override/dataset:clouds
experiment/own_scans_icp: choice2=override/sampler:pose choice3=override/recipe:paper m=32
experiment/own_scans_icp: sizes=[16,32,128] baselines.random._target_=samplers.random.RandomSampler
experiment/own_scans_icp: baselines.fps_farthest._target_=samplers.fps.FPSSampler
experiment/own_scans_icp: baselines.fps_farthest.start=farthest
experiment/own_scans_icp: baselines.information._target_=samplers.information.InformationSampler
experiment/own_scans_icp: baselines.information.neighbours=12
experiment/own_scans_icp: baselines.steady._target_=samplers.steady.SteadySampler
experiment/own_scans_icp: baselines.steady.neighbours=12 batch_size=8 val_fraction=0.2
experiment/own_scans_icp: trainer.check_val_every_n_epoch=5 epochs.sampler=20 optimizer.lr=0.003
experiment/reconstruction_paper: choice0=override/task:reconstruction
experiment/reconstruction_paper: choice1=override/dataset:modelnet40 choice2=override/sampler:mops
experiment/reconstruction_paper: choice3=override/optimizer:exponential
experiment/reconstruction_paper: choice4=override/recipe:paper dataset.classes=['airplane']
experiment/reconstruction_paper: epochs.task=400 epochs.sampler=250 batch_size=50 val_fraction=0.0
experiment/registration_paper: choice0=override/task:registration
experiment/registration_paper: choice1=override/dataset:modelnet40 choice2=override/sampler:mops
experiment/registration_paper: choice3=override/optimizer:exponential choice4=override/recipe:paper
experiment/registration_paper: epochs.task=250 epochs.sampler=250 val_fraction=0.0
logger/csv: _target_=lightning.pytorch.loggers.CSVLogger
logger/mlflow: _target_=lightning.pytorch.loggers.MLFlowLogger experiment_name=mops_lightning
logger/mlflow: tracking_uri=file:${hydra:runtime.cwd}/mlruns log_model=False
logger/wandb: _target_=lightning.pytorch.loggers.WandbLogger project=mops_lightning offline=False
optimizer/exponential: choice0=_self_ choice1=optionalexponential@_here_:${task}
optimizer/exponential: _target_=torch.optim.Adam lr=0.0005
optimizer/exponential: schedule._target_=training.schedules.exponential schedule.end_lr=1e-05
optimizer/exponential/registration: lr=0.0001
optimizer/muon: lr=0.002 schedule._target_=training.schedules.one_cycle schedule.warmup=0.3
optimizer/one_cycle: _target_=torch.optim.Adam lr=0.001
optimizer/one_cycle: schedule._target_=training.schedules.one_cycle schedule.warmup=0.3
optimizer/one_cycle_fmops: choice0=one_cycle
optimizer/one_cycle_fmops: choice1=optionalone_cycle_fmops@_here_:${task}_${recipe}
optimizer/one_cycle_fmops/registration_fast: lr=0.005
optimizer/one_cycle_snet: choice0=one_cycle choice1=optionalone_cycle_snet@_here_:${task}
optimizer/one_cycle_snet/classification: lr=0.01
optimizer/one_cycle_snet/reconstruction: lr=0.0005
optimizer/step_decay: _target_=torch.optim.Adam lr=0.001
optimizer/step_decay: schedule._target_=training.schedules.step_decay schedule.every=6250
optimizer/step_decay: schedule.factor=0.7 schedule.floor_lr=1e-05
optimizer/step_decay_snet: choice0=step_decay choice1=_self_ lr=0.01 schedule.every=18750
recipe/fast: choice0=paper choice1=_self_ choice2=optionalfast@_here_:${task} train_points=256
recipe/fast: warm_start=True distillation=3.0 ema_span=0.2
recipe/fast/classification: task_points=256
recipe/fast/reconstruction: distillation=0.0
recipe/fast/registration: choice0=_self_ choice1=optionalregistration@_here_:${dataset}
recipe/fast/registration: train_points=512 distillation=0.0 feature_distillation=1.0
recipe/fast/registration/shapes: train_points=256 task_points=128
sampler/fmops: choice0=_self_ choice1=optionalmops@_here_:${task}
sampler/fmops: choice2=optionalfmops@_here_:${task}_${oc.select:recipe,none}
sampler/fmops: choice3=override/optimizer@_global_.optimizer:one_cycle_fmops
sampler/fmops/classification_fast: min_size=8
sampler/fmops/classification_paper: size_sampling=uniform
sampler/fmops/reconstruction_paper: size_sampling=uniform
sampler/fmops/registration_fast: m_max=64 anchors=framed anchor_width=2.0 min_size=8 num_sizes=2
sampler/fmops/registration_fast: rho_channels=[256,128]
sampler/fmops/registration_paper: m_max=64 size_sampling=uniform
sampler/mops: choice0=_self_ choice1=optionalmops@_here_:${task}
sampler/mops/reconstruction: alpha=0.2 tau_min=0.5
sampler/mops/registration: alpha=1.0
sampler/samplenet: choice0=_self_ choice1=optionalsnet@_here_:${task}
sampler/samplenet: choice2=optionalsamplenet@_here_:${task}
sampler/samplenet: choice3=override/optimizer@_global_.optimizer:one_cycle_snet
sampler/samplenet/reconstruction: k=16 beta=0.0001 sigma_min=0.0001
sampler/samplenet/registration: k=8 beta=0.01 sigma_min=0.01
sampler/samplenet_progressive: choice0=_self_ choice1=optionalsnet@_here_:${task}
sampler/samplenet_progressive: choice2=optionalsamplenet@_here_:${task}
sampler/samplenet_progressive: choice3=optionalsamplenet_progressive@_here_:${task}
sampler/samplenet_progressive: choice4=override/optimizer@_global_.optimizer:one_cycle_snet
sampler/samplenet_progressive: coverage=0.5 coverage_per_point=0.03333333333333333
sampler/samplenet_progressive/reconstruction: min_size=16 size_reduction=mean
sampler/samplenet_progressive/registration: size_reduction=mean coverage=1.0 coverage_per_point=0.0
sampler/snet: choice0=_self_ choice1=optionalsnet@_here_:${task}
sampler/snet: choice2=override/optimizer@_global_.optimizer:one_cycle_snet
sampler/snet/reconstruction: alpha=0.01 coverage=0.0 coverage_per_point=0.015625
sampler/snet/reconstruction: feature_channels=[64,128,128,256,128] head_channels=[256,256]
sampler/snet/reconstruction: head_norm=False output_norm=False
sampler/snet/registration: alpha=0.01 output_norm=False
sampler_recipe/registration_fast_fmops: feature_distillation=0.0
task/classification: choice0=net:pointnet choice1=_self_
task/icp: choice0=net:plane_icp choice1=_self_
task/net/foldingnet: pieces=1
task/net/hierarchical: choice0=/sampler@sampler:fps choice1=_self_ sampler._partial_=True
task/net/hierarchical_segmentation: choice0=/sampler@sampler:fps choice1=_self_
task/net/hierarchical_segmentation: sampler._partial_=True
task/net/pcrnet: choice0=_self_ choice1=optionalpcrnet@_here_:${dataset}
task/net/pcrnet/shapes: iterations=2
task/own: choice0=net:pointnet choice1=_self_
task/reconstruction: choice0=net:autoencoder choice1=_self_
task/registration: choice0=net:pcrnet choice1=_self_
task/segmentation: choice0=net:hierarchical_segmentation choice1=_self_
task_settings/classification: augment.task.rotate_up=True augment.task.jitter=0.01
task_settings/classification: augment.task.stretch=1.0 augment.task.shift=0.0
task_settings/reconstruction: epochs.task=200 epochs.sampler=60
task_settings/registration: task_lr_scale=0.1
trainer/auto: choice0=default
trainer/cpu: choice0=default choice1=_self_ accelerator=cpu
trainer/ddp: choice0=default choice1=_self_ devices=auto strategy=ddp
trainer/default: _target_=lightning.Trainer accelerator=auto devices=1 precision=32-true
trainer/gpu: choice0=default choice1=_self_ accelerator=gpu
"""


def values_written_here() -> dict[str, set[str]]:
    values: dict[str, set[str]] = {}
    for line in VALUES.strip().splitlines():
        file, settings = line.split(": ")
        values.setdefault(file, set()).update(settings.split())
    return values


def values_of(file: str, content: DictConfig) -> set[str]:
    """Return the choices of a file, and its values that are no references or class defaults."""
    plain: Any = OmegaConf.to_container(content)
    values = set()
    for number, choice in enumerate(plain.pop("defaults", [])):
        values.add(f"choice{number}={text_of_choice(choice)}")
    for name, value in dotted(plain).items():
        of_class = file in FILES and "." not in name and name not in DIFFERENT.get(file, set())
        is_reference = isinstance(value, str) and value.startswith(("${", "???"))
        if not of_class and not is_reference:
            text = str(value).replace(" ", "").removeprefix("mops_lightning.")
            values.add(f"{name}={text}")
    return values


def text_of_choice(choice: str | dict[str, Any]) -> str:
    """Return an entry of Hydra's defaults list without spaces."""
    if isinstance(choice, str):
        return choice
    ((group, name),) = choice.items()
    return f"{group}:{name}".replace(" ", "")


def files() -> Iterator[Path]:
    yield CONF / "config.yaml"
    for group in GROUPS:
        yield from CONF.joinpath(group).rglob("*.yaml")


def test_choices_and_values_that_are_no_defaults_of_a_class_are_these():
    found = {}
    for path in files():
        content = OmegaConf.load(path)
        assert isinstance(content, DictConfig)
        relative = path.relative_to(CONF)
        values = values_of(relative.as_posix(), content)
        if values:
            found[relative.with_suffix("").as_posix()] = values

    assert found == values_written_here()
