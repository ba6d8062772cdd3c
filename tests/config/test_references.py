"""Which values of conf/ are taken from other settings, such as the seed of a sampler."""

from typing import Any

from omegaconf import OmegaConf

from mops_lightning.tree import dotted
from tests.config.test_specialised_values import CONF, files

SEEDED = {
    "dataset/clouds",
    "dataset/mesh_sequence",
    "dataset/meshes",
    "dataset/scans_of_shapes",
    "dataset/shapes",
    "sampler/covariance",
    "sampler/critical",
    "sampler/fps",
    "sampler/information",
    "sampler/normal_space",
    "sampler/poisson",
    "sampler/pose",
    "sampler/random",
    "sampler/steady",
}

OF_ONE_SIZE = {
    "sampler/covariance",
    "sampler/critical",
    "sampler/fps",
    "sampler/gumbel",
    "sampler/information",
    "sampler/mops",
    "sampler/mops_stage",
    "sampler/normal_space",
    "sampler/own",
    "sampler/poisson",
    "sampler/random",
    "sampler/samplenet",
    "sampler/serial",
    "sampler/snet",
    "sampler/steady",
    "sampler/voxel",
}

MESHES = {
    "dataset/clouds",
    "dataset/mesh_sequence",
    "dataset/meshes",
    "dataset/shapenet_core",
}

DECODERS = {
    "task/net/atlasnet",
    "task/net/autoencoder",
    "task/net/foldingnet",
    "task/net/mfoldingnet",
}

FOLDER_OF_A_RUN = "${out}/${names.task}/${names.dataset}/${run_label:}/${now:%Y-%m-%d_%H-%M-%S}"

REFERENCES = {
    ("augment.sampler.rotate_up", "${..task.rotate_up}"): {"experiment/own_scans"},
    ("cache", "${cache}/meshes"): MESHES,
    ("cache", "${cache}/shapes"): {"dataset/scans_of_shapes", "dataset/shapes"},
    ("callbacks.pictures.up", "${augment.task.rotate_up}"): {"experiment/own_scans"},
    ("epochs.joint", "${.sampler}"): {"config"},
    ("hydra.run.dir", FOLDER_OF_A_RUN): {"config"},
    ("hydra.sweep.dir", "${out}/multirun/${now:%Y-%m-%d_%H-%M-%S}"): {"config"},
    ("hydra.sweep.subdir", "${hydra.job.num}"): {"config"},
    ("m", "${m}"): OF_ONE_SIZE,
    ("max_epochs", "${epochs.${learn}}"): {"trainer/default"},
    ("n_points", "${dataset.n_points}"): DECODERS,
    ("name", "${names.task}-${run_label:}"): {"logger/wandb"},
    ("names", "${group_choices:}"): {"config"},
    ("run_name", "${names.task}-${run_label:}"): {"logger/mlflow"},
    ("seed", "${seed}"): SEEDED,
    ("tracking_uri", "file:${hydra:runtime.cwd}/mlruns"): {"logger/mlflow"},
}
"""The files with a setting, by the setting and what it is taken from."""


def test_references_to_other_settings_are_these():
    found: dict[tuple[str, str], set[str]] = {}
    for path in files():
        content: Any = OmegaConf.to_container(OmegaConf.load(path))
        content.pop("defaults", None)
        name = path.relative_to(CONF).with_suffix("").as_posix()
        for setting, value in dotted(content).items():
            if isinstance(value, str) and "${" in value:
                found.setdefault((setting, value), set()).add(name)

    assert found == REFERENCES
