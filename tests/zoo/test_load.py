from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from mops_lightning import (
    FMOPSNet,
    FPSSampler,
    GumbelSampler,
    MOPSNet,
    ProgressiveSampleNet,
    SampleOutput,
    Sampler,
    load,
)
from mops_lightning.channels import Channel, PointChannels
from mops_lightning.config.groups import conf_dir
from mops_lightning.errors import UserError
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.tasks.classification import Classification
from mops_lightning.zoo import weights
from mops_lightning.zoo.load import load_net, package_samplers

FMOPS = {"_target_": "mops_lightning.samplers.fmops.FMOPSNet", "m_max": 16}


@pytest.fixture
def save(tmp_path):
    """Write a weights file whose configuration has this sampler node."""

    def written(node, module=None, learn="sampler"):
        config = {"learn": learn, "sampler": node}
        weights.save(tmp_path / weights.FILE, module or FMOPSNet(16), config, {})
        return tmp_path / weights.FILE

    return written


def test_load_file_or_folder_gives_the_saved_sampler(save):
    saved = FMOPSNet(16).eval()
    path = save(FMOPS, saved)
    points = torch.rand(2, 40, 3)
    random = torch.get_rng_state()
    for given in (path, str(path), path.parent):
        sampler = load(given)
        assert torch.equal(torch.get_rng_state(), random)
        assert isinstance(sampler, FMOPSNet)
        assert not sampler.training
        with torch.no_grad():
            assert torch.equal(sampler(points, 5).points, saved(points, 5).points)


def test_load_of_a_sampler_that_sees_no_channels_takes_them_along(tmp_path):
    node = {"_target_": "mops_lightning.samplers.fps.FPSSampler", "m": 4, "start": "farthest"}
    config = {"learn": "joint", "sampler": node}
    channels = PointChannels([Channel("intensity", 100.0, 50.0)])
    weights.save(tmp_path / weights.FILE, FPSSampler(4), config, {}, channels=channels)
    cloud = torch.rand(40, 4)

    points, rows = load(tmp_path).downsample(cloud)

    assert torch.equal(points, cloud[rows])
    assert torch.equal(rows, FPSSampler(4, start="farthest").downsample(cloud)[1])


@pytest.mark.parametrize(
    "saved",
    [
        FMOPSNet(16, point_channels=2),
        MOPSNet(16, point_channels=2),
        ProgressiveSampleNet(16, point_channels=2),
        GumbelSampler(16, point_channels=2),
    ],
)
def test_load_gives_a_trained_sampler_its_channels(saved, tmp_path):
    name = f"{type(saved).__module__}.{type(saved).__qualname__}"
    size = "m_max" if saved.flexible else "m"
    config = {"learn": "sampler", "sampler": {"_target_": name, size: 16}}
    channels = PointChannels([Channel("intensity", 100.0, 50.0), Channel("time")])
    weights.save(tmp_path / weights.FILE, saved, config, {}, channels=channels)

    sampler = load(tmp_path)

    assert sampler.point_channels == channels
    assert sampler(torch.rand(1, 40, 5)).points.shape == (1, 16, 5)


def test_load_net_gives_the_saved_task_net(tmp_path):
    task = Classification(PointNetVanilla(3, dropout=0.1), 3).eval()
    node = {"_target_": "mops_lightning.nets.pointnet.PointNetVanilla", "dropout": 0.1}
    config = {"learn": "task", "task": {"net": node}}
    weights.save(tmp_path / weights.FILE, task, config, {}, ("a", "b", "c"))
    net = load_net(tmp_path)
    assert not net.training
    points = torch.rand(2, 40, 3)
    assert torch.equal(net(points), task.net(points))


def test_load_net_refuses_samplers_and_other_classes(save, tmp_path):
    with pytest.raises(UserError, match="holds a sampler, not a task net"):
        load_net(save(FMOPS))
    for target in ("os.system", "torch.nn.Linear", ["os.system"], FMOPS["_target_"]):
        config = {"learn": "task", "task": {"net": {"_target_": target}}}
        weights.save(tmp_path / weights.FILE, FMOPSNet(16), config, {})
        with pytest.raises(UserError, match=r"task\.net must be one of PointNetVanilla.*got"):
            load_net(tmp_path)


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "torch.nn.Linear",
        "mops_lightning.samplers.base.Sampler",
        "mops_lightning.nets.pointnet.PointNetVanilla",
        ["mops_lightning.samplers.mops.MOPSNet"],
        None,
    ],
)
def test_load_other_targets_are_refused(save, target):
    with pytest.raises(UserError, match=r"_target_ must be a sampler of mops_lightning, got"):
        load(save({**FMOPS, "_target_": target}))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"colour": 3}, "colour"),
        ({"m_max": -1}, "at least 1, got -1"),
        ({"m_max": None}, "a whole number of at least 1, got None"),
        ({"tau_min": "low"}, "cannot build"),
        ({"feature_channels": {"_target_": "os.getcwd"}}, "cannot build"),
        ({"feature_channels": [{"_target_": "os.getcwd"}]}, "cannot build"),
        ({"feature_channels": [[None]]}, "cannot build"),
        ({"feature_channels": [8] * 1000}, "cannot build .* more than the [0-9]+ tensors"),
        ({"feature_channels": [10**6] * 2}, "another net's weights"),  # 4 TB
        ({"m_max": 2**70}, "cannot build"),
        ({"m_max": 17}, r"queries.weight: .*\[16, 128\].*\[17, 128\]"),
    ],
)
def test_load_wrong_arguments_are_one_error(save, change, words):
    path = save({**FMOPS, **change})
    with pytest.raises(UserError, match=rf"(?s){path}.*{words}"):
        load(path)


def test_load_task_net_or_missing_file_is_refused(save, tmp_path):
    with pytest.raises(UserError, match=r"task net.*learn=sampler"):
        load(save(FMOPS, learn="task"))
    with pytest.raises(UserError, match=r"no file .*nowhere"):
        load(tmp_path / "nowhere.safetensors")
    with pytest.raises(UserError, match="path must be a string or a Path, got None"):
        load(None)  # type: ignore[arg-type]


def test_samplers_of_conf_can_all_be_loaded():
    known = {f"{cls.__module__}.{cls.__qualname__}" for cls in package_samplers()}
    for path in (conf_dir() / "sampler").glob("*.yaml"):
        if path.stem != "own":  # names no class
            node: Any = OmegaConf.load(path)
            assert node.get("sampler", node)["_target_"] in known, path


class Scaled(Sampler):
    """A sampler from outside the package."""

    def __init__(self, m: int, size: int = 3):
        super().__init__(m)
        self.scale = torch.nn.Parameter(torch.ones(size))

    def sample(self, points, m):
        return SampleOutput(points[:, :m] * self.scale, None, {})


def test_load_class_from_outside_is_given(save):
    own = Scaled(4)
    torch.nn.init.constant_(own.scale, 2)
    path = save({"_target_": "my_package.Scaled", "m": 4}, own)
    with pytest.raises(UserError, match=r"'my_package\.Scaled'.*load\(path, cls=MySampler\)"):
        load(path)
    sampler = load(path, cls=Scaled)
    points = torch.rand(2, 9, 3)
    assert isinstance(sampler, Scaled)
    assert torch.equal(sampler(points).points, 2 * points[:, :4])
    with pytest.raises(UserError, match="another net's weights"):
        load(save({"_target_": "my_package.Scaled", "m": 4, "size": 2}, own), cls=Scaled)


@pytest.mark.parametrize("node", [5, ["a"], "fps", {1: 2}])
def test_load_sampler_that_is_no_group_raises(node, save):
    with pytest.raises(UserError, match="sampler"):
        load(save(node))
