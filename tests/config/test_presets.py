"""The values of presets and of files for one choice in particular, as their pages document them.

Values that are defaults of a class are compared with these in ``test_defaults.py``.
"""

from typing import Any

import pytest
from omegaconf import OmegaConf

from mops_lightning.config.compose import compose

PRESETS: dict[str, dict[str, Any]] = {
    "": {
        "recipe.train_points": 256,
        "recipe.warm_start": True,
        "recipe.distillation": 3.0,
        "recipe.ema_span": 0.2,
        "recipe.task_points": 256,
        "optimizer._target_": "torch.optim.Adam",
        "optimizer.lr": 0.001,
        "optimizer.schedule.warmup": 0.3,
        "pretrain.lr": 0.001,
        "augment.task.rotate_up": True,
        "augment.task.jitter": 0.01,
        "augment.task.stretch": 1.0,
        "augment.task.shift": 0.0,
        "augment.sampler": None,
        "trainer.accelerator": "auto",
        "trainer.devices": 1,
        "trainer.precision": "32-true",
        "callbacks.pictures.up": "y",
    },
    "task=reconstruction": {
        "recipe.distillation": 0.0,
        "recipe.train_points": 256,
        "epochs.task": 60,
        "epochs.sampler": 10,
    },
    "task=registration dataset=modelnet40": {
        "recipe.train_points": 512,
        "recipe.distillation": 0.0,
        "recipe.task_points": None,
        "recipe.feature_distillation": 1.0,
        "task.net.iterations": 1,
        "pretrain_from": None,
    },
    "task=registration": {
        "recipe.distillation": 0.0,
        "recipe.task_points": 128,
        "val_fraction": 0.0125,
        "pretrain.lr": 0.0005,
        "dataset.classes": "asymmetric",
        "dataset.train_per_class": 640,
        "dataset.test_per_class": 40,
        "task.net.iterations": 2,
    },
    "task=segmentation": {
        "dataset.classes": "parts",
        "epochs.task": 30,
        "epochs.sampler": 10,
        "pretrain.lr": 0.004,
    },
    "dataset=scans_of_shapes": {
        "epochs.task": 12,
        "epochs.sampler": 10,
    },
    "dataset=scans_of_shapes task=reconstruction": {
        "epochs.task": 60,
        "epochs.sampler": 10,
    },
    "dataset=scans_of_shapes task=segmentation": {
        "dataset.classes": "parts",
        "epochs.task": 30,
        "epochs.sampler": 10,
        "pretrain.lr": 0.004,
    },
    "dataset=meshes dataset.root=x": {
        "epochs.task": 20,
        "epochs.sampler": 8,
        "dataset.crop": "surface",
    },
    "dataset=meshes dataset.root=x task=registration": {
        "epochs.task": 40,
    },
    "dataset=mesh_sequence dataset.root=x task=registration": {
        "epochs.task": 40,
        "dataset.n_points": 40960,
        "dataset.gap": 2,
    },
    "dataset=mesh_sequence dataset.root=x": {
        "dataset.test_frames": "last",
        "dataset.crops": 1,
        "dataset.crop": "surface",
    },
    "dataset=shapenet_core": {
        "dataset.test_share": 0.15,
        "dataset.crop": "whole",
        "dataset.crops": 1,
        "dataset.n_points": 1024,
    },
    "optimizer=muon": {
        "optimizer._target_": "mops_lightning.training.muon.MuonAdam",
        "optimizer.lr": 0.002,
        "optimizer.schedule.warmup": 0.3,
    },
    "optimizer=exponential": {
        "optimizer._target_": "torch.optim.Adam",
        "optimizer.lr": 0.0005,
        "optimizer.schedule.end_lr": 1e-05,
    },
    "task=registration optimizer=exponential": {
        "optimizer.lr": 0.0001,
    },
    "optimizer=step_decay": {
        "optimizer._target_": "torch.optim.Adam",
        "optimizer.lr": 0.001,
        "optimizer.schedule.every": 6250,
        "optimizer.schedule.factor": 0.7,
        "optimizer.schedule.floor_lr": 1e-05,
    },
    "optimizer=step_decay_snet": {
        "optimizer.lr": 0.01,
        "optimizer.schedule.every": 18750,
        "optimizer.schedule.factor": 0.7,
    },
    "sampler=fmops": {
        "sampler.min_size": 8,
        "sampler.num_sizes": 4,
        "sampler.size_sampling": "nested",
    },
    "task=reconstruction sampler=fmops recipe=paper": {
        "sampler.size_sampling": "uniform",
        "sampler.min_size": 1,
    },
    "task=registration sampler=fmops recipe=paper": {
        "sampler.size_sampling": "uniform",
    },
    "task=registration sampler=fmops": {
        "sampler.min_size": 8,
        "sampler.num_sizes": 2,
        "sampler.rho_channels": [256, 128],
        "optimizer._target_": "mops_lightning.training.muon.MuonAdam",
    },
    "task=reconstruction sampler=snet": {
        "sampler.alpha": 0.01,
        "sampler.coverage": 0.0,
        "sampler.coverage_per_point": 0.015625,
        "sampler.head_norm": False,
        "sampler.output_norm": False,
        "sampler.head_channels": [256, 256],
        "sampler.feature_channels": [64, 128, 128, 256, 128],
    },
    "task=registration sampler=snet": {
        "sampler.alpha": 0.01,
        "sampler.head_norm": True,
        "sampler.output_norm": False,
    },
    "task=reconstruction sampler=samplenet": {
        "sampler.k": 16,
        "sampler.beta": 0.0001,
        "sampler.sigma_min": 0.0001,
        "sampler.alpha": 0.01,
    },
    "task=registration sampler=samplenet": {
        "sampler.k": 8,
        "sampler.beta": 0.01,
        "sampler.sigma_min": 0.01,
        "sampler.alpha": 0.01,
    },
    "task=reconstruction sampler=samplenet_progressive": {
        "sampler.min_size": 16,
        "sampler.size_reduction": "mean",
        "sampler.k": 16,
    },
    "task=registration sampler=samplenet_progressive": {
        "sampler.size_reduction": "mean",
        "sampler.coverage": 1.0,
        "sampler.coverage_per_point": 0.0,
        "sampler.min_size": 2,
    },
    "experiment=classification_paper": {
        "pretrain._target_": "torch.optim.Adam",
        "pretrain.lr": 0.001,
        "pretrain.schedule.every": 6250,
        "names.recipe": "paper",
        "epochs.task": 250,
        "epochs.sampler": 250,
        "m": 32,
    },
    "experiment=classification_snet": {
        "pretrain.schedule.every": 6250,
        "optimizer.schedule.every": 18750,
        "epochs.task": 250,
        "names.recipe": "paper",
        "names.dataset": "modelnet40",
        "names.sampler": "snet",
    },
    "experiment=reconstruction_paper": {
        "optimizer.lr": 0.0005,
        "optimizer.schedule.end_lr": 1e-05,
        "batch_size": 50,
        "val_fraction": 0.0,
        "dataset.classes": ["airplane"],
        "names.dataset": "modelnet40",
        "names.recipe": "paper",
        "sampler.alpha": 0.2,
    },
    "experiment=registration_paper": {
        "optimizer.lr": 0.0001,
        "optimizer.schedule.end_lr": 1e-05,
        "sampler.alpha": 1.0,
        "val_fraction": 0.0,
        "names.dataset": "modelnet40",
        "names.recipe": "paper",
        "epochs.task": 250,
        "epochs.sampler": 250,
    },
    "experiment=modelnet40_quick": {
        "m": 32,
        "batch_size": 64,
        "val_fraction": 0.0,
        "epochs.task": 12,
        "epochs.sampler": 30,
        "optimizer._target_": "mops_lightning.training.muon.MuonAdam",
        "optimizer.lr": 0.002,
        "pretrain.lr": 0.002,
        "recipe.task_points": None,
        "augment.task.rotate_up": False,
        "names.recipe": "fast",
        "names.dataset": "modelnet40",
    },
    "experiment=las_segmentation dataset.root=x": {
        "learn": "joint",
        "weights": None,
        "m": 205,
        "batch_size": 8,
        "val_fraction": 0.0,
        "dataset.n_points": 4096,
        "dataset.crop": "tiles",
        "dataset.label": "classification",
        "dataset.features": ["intensity", "return_number", "number_of_returns"],
        "task.net.points": [128, 32],
        "epochs.joint": 30,
        "recipe.train_points": None,
        "augment.task.rotate_up": "z",
        "augment.sampler.rotate_up": "z",
        "optimizer.lr": 0.004,
        "callbacks.pictures.up": "z",
        "names.sampler": "fps",
        "names.recipe": "fast",
    },
    "experiment=own_scans dataset.root=x": {
        "m": 32,
        "sizes": [8, 16, 32, 128],
        "batch_size": 16,
        "val_fraction": 0.2,
        "sampler.m_max": 128,
        "sampler.num_sizes": 2,
        "sampler.min_size": 6,
        "sampler.anchors": "fps",
        "sampler.anchor_width": 0.8,
        "sampler.feature_channels": [64, 128, 128, 256, 128],
        "recipe.feature_distillation": 1.0,
        "recipe.train_points": 512,
        "baselines.fps_farthest.start": "farthest",
        "augment.task.rotate_up": "z",
        "augment.sampler.rotate_up": "z",
        "task.exact_up_to": None,
        "trainer.check_val_every_n_epoch": 3,
        "callbacks.early_stopping.patience": 6,
        "callbacks.pictures.up": "z",
        "callbacks.early_stopping.monitor": "val/completed/nre_cd",
    },
    "experiment=own_scans_icp dataset.root=x": {
        "m": 32,
        "sizes": [16, 32, 128],
        "batch_size": 8,
        "val_fraction": 0.2,
        "trainer.check_val_every_n_epoch": 5,
        "epochs.sampler": 20,
        "optimizer.lr": 0.003,
        "names.recipe": "paper",
        "names.sampler": "pose",
        "baselines.information.neighbours": 12,
        "baselines.steady.neighbours": 12,
        "baselines.fps_farthest.start": "farthest",
    },
    "debug=overfit": {
        "trainer.overfit_batches": 2,
    },
    "debug=profiler": {
        "trainer.profiler": "simple",
        "epochs.task": 1,
        "epochs.sampler": 1,
    },
    "logger=mlflow": {
        "logger.experiment_name": "mops_lightning",
        "logger.run_name": "classification-mops-m32",
        "logger.log_model": False,
    },
    "logger=wandb": {
        "logger.project": "mops_lightning",
        "logger.name": "classification-mops-m32",
        "logger.offline": False,
    },
}
"""Choices on the command line, and the values of settings then."""


@pytest.mark.parametrize("chosen", PRESETS)
def test_choices_give_the_documented_values(chosen):
    cfg = compose(chosen.split())

    found = {path: OmegaConf.select(cfg, path) for path in PRESETS[chosen]}
    assert found == PRESETS[chosen]


BASELINES = {
    "classification": ["random", "voxel", "fps"],
    "reconstruction": ["random", "voxel", "fps"],
    "segmentation": ["random", "voxel", "fps"],
    "registration": ["fps_farthest", "fps"],
}


@pytest.mark.parametrize("task", BASELINES)
def test_baselines_of_a_task_are_in_the_order_of_tables(task):
    baselines = compose([f"task={task}"]).baselines

    assert list(baselines) == BASELINES[task]
    for name, node in baselines.items():
        module = str(node["_target_"]).split(".")[-2]
        assert module == str(name).partition("_")[0]


NETS = {
    "classification": "pointnet",
    "reconstruction": "autoencoder",
    "registration": "pcrnet",
    "segmentation": "hierarchical_segmentation",
    "icp": "plane_icp",
}


@pytest.mark.parametrize("task", NETS)
def test_task_has_its_usual_net(task):
    cfg = compose([f"task={task}"])

    assert (cfg.names.task, cfg.names.net) == (task, NETS[task])
