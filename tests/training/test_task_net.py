"""The task net of a trained run, outside of a run."""

import shutil

import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.records import run_record
from mops_lightning.training.task_net import read_task
from mops_lightning.zoo.load import load_net


def test_model_of_a_task_net_gives_its_task():
    trained = read_task("pointnet.modelnet40")

    assert type(trained.task).__name__ == "Classification"
    assert len(trained.outputs) == 40
    assert trained.sampler is None
    assert not trained.task.training
    assert not any(value.requires_grad for value in trained.task.parameters())
    points = torch.rand(2, 64, 3)
    assert torch.equal(trained.task.net(points), load_net("pointnet.modelnet40")(points))


def test_model_of_a_sampler_gives_the_task_net_it_was_trained_for():
    trained = read_task("mops.modelnet40-m8-seed0")

    assert trained.sampler is not None
    assert trained.sampler.name == "mops.modelnet40-m8-seed0.safetensors"
    assert type(trained.task.net).__name__ == "PointNetVanilla"


@pytest.fixture
def run_folder(tmp_path):
    """A folder with the record and the weights of a model, as a run leaves them."""
    from mops_lightning.zoo import model_file, names, weights

    path = names.available()["pointnet.modelnet40"]
    content = weights.read(path)
    record = run_record.from_plain(model_file.read_card(path)["record"])
    record.files = {"weights": weights.FILE}
    header = {
        "schema": model_file.WEIGHTS,
        "config": record.config,
        "metrics": {},
        "classes": content["classes"],
    }
    model_file.write(tmp_path / weights.FILE, header, content["state"])
    run_record.write(tmp_path, record)
    return tmp_path


def test_weights_file_stands_for_its_run(run_folder):
    of_folder = read_task(str(run_folder))
    of_file = read_task(str(run_folder / "weights.safetensors"))
    alone = run_folder / "alone" / "net.safetensors"
    alone.parent.mkdir()
    shutil.copy(run_folder / "weights.safetensors", alone)

    of_copy = read_task(str(alone))

    for other in (of_file, of_copy):
        assert other.outputs == of_folder.outputs
        state = other.task.state_dict()
        for name, value in of_folder.task.state_dict().items():
            assert torch.equal(state[name], value)


def test_run_that_failed_or_names_own_classes_is_refused(run_folder):
    record = run_record.read(run_folder)
    record.status = "failed"
    run_record.write(run_folder, record)
    with pytest.raises(UserError, match=r"failed\. Give a completed run"):
        read_task(str(run_folder))

    record.status = "completed"
    record.overrides = ["task._target_=my_task.MyTask"]
    run_record.write(run_folder, record)
    with pytest.raises(UserError, match=r"task\._target_, which is not accepted"):
        read_task(str(run_folder))


def test_file_of_a_samplers_run_is_taken_if_it_holds_the_task_net(tmp_path):
    from mops_lightning import FMOPSNet
    from mops_lightning.zoo import weights

    node = {"_target_": "mops_lightning.samplers.fmops.FMOPSNet", "m_max": 16}
    path = tmp_path / "a.safetensors"
    weights.save(path, FMOPSNet(16), {"learn": "sampler", "sampler": node}, {})
    with pytest.raises(UserError, match="no configuration of a run"):
        read_task(str(path))

    from mops_lightning.zoo import model_file, names

    card = model_file.read_card(names.available()["fmops.modelnet40-m512"])
    weights.save(path, FMOPSNet(16), card["record"]["config"], {})
    with pytest.raises(UserError, match="a sampler without its task net"):
        read_task(str(path))

    net = read_task("pointnet.modelnet40")
    weights.save(path, net.task, card["record"]["config"], {}, net.outputs)
    beside = read_task(str(path))  # as a sampler's run writes its task net
    assert beside.sampler is None
    assert beside.outputs == net.outputs

    path.write_bytes(b"no weights")
    with pytest.raises(UserError, match="damaged"):
        read_task(str(path))
