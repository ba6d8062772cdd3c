"""A small run with weights, and the models made from it."""

import json

import torch
from safetensors import safe_open
from safetensors.torch import save_file

from mops_lightning.records import run_record
from mops_lightning.samplers.fmops import FMOPSNet
from mops_lightning.zoo import model_file, weights
from tests.support.records import record

NODE = {"_target_": "mops_lightning.samplers.fmops.FMOPSNet", "m_max": 16}
NAMES = {"task": "classification", "net": "pointnet", "dataset": "shapes", "sampler": "fmops"}


def write_run(folder, node=NODE, learn="sampler", **fields):
    """Write a completed run of an untrained FMOPS-Net; return the net."""
    torch.manual_seed(0)
    net = FMOPSNet(16).eval()
    config = {
        "learn": learn,
        "m": 8,
        "names": NAMES,
        "sampler": node,
        "dataset": {"n_points": 64},
        "trainer": {"max_epochs": 3},
    }
    metrics = {"test/m8/generated/accuracy": 0.5, "test/m8/fps/accuracy": 0.25}
    metrics["test/m16/generated/accuracy"] = 0.75
    content = {
        "config": config,
        "metrics": metrics,
        "score": 0.5,
        "files": {"weights": "weights.safetensors"},
        "score_name": "test/m8/generated/accuracy",
        **fields,
    }
    folder.mkdir(parents=True)
    run_record.write(folder, record(**content))
    weights.save(folder / "weights.safetensors", net, config, metrics)
    return net


def rewrite(path, state=None, **changes):
    """Write a weights file or model with other tensors or another header, unchecked."""
    with safe_open(path, "torch") as file:
        header = json.loads(file.metadata()[model_file.KEY])
        tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
    tensors |= state or {}
    header |= {"sha256": weights.digest(tensors), **changes}
    header = {name: value for name, value in header.items() if value != "absent"}
    save_file(tensors, path, {model_file.KEY: json.dumps(header)})
