from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf

from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.zoo.nets import NETS, load_net

ROOT = Path(__file__).parents[2]


def test_load_net_of_kept_run_is_the_trained_net():
    before = torch.get_rng_state()
    found = load_net(
        ROOT / "results" / "classification" / "runs" / "pointnet", "classification", 40
    )
    assert torch.equal(torch.get_rng_state(), before)
    assert found.kind == "pointnet"
    assert isinstance(found.net, PointNetVanilla)
    assert not found.net.training
    state = {f"net.{name}": value for name, value in found.net.state_dict().items()}
    assert all(torch.equal(state[name], value) for name, value in found.content["state"].items())


def test_load_net_by_name():
    found = load_net("pointnet.modelnet40", "classification", 40)
    assert (found.kind, found.content["config"]["seed"]) == ("pointnet", 0)


def test_nets_of_conf_can_all_be_loaded():
    known = {f"{cls.__module__}.{cls.__qualname__}" for cls in NETS.values()}
    targets = set()
    for path in (ROOT / "conf" / "task" / "net").glob("*.yaml"):
        node: Any = OmegaConf.load(path)
        targets.add(node["_target_"])
    assert targets == known | {"mops_lightning.nets.icp.ICP"}  # which has no weights
