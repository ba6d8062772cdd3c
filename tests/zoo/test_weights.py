import pytest
import torch
from torch import nn

from mops_lightning.errors import UserError
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.records import run_record
from mops_lightning.zoo import weights
from tests.support.records import record


@pytest.fixture
def saved(tmp_path):
    torch.manual_seed(0)
    net = PointNetVanilla(4)
    weights.save(tmp_path / "weights.pt", net, {"seed": 1}, {"accuracy": 0.5})
    return net, tmp_path / "weights.pt"


def test_save_and_load_into_returns_equal_tensors_and_config(saved):
    net, path = saved
    other = PointNetVanilla(4)
    content = weights.load_into(other, path)
    assert all(
        torch.equal(a, b)
        for a, b in zip(net.state_dict().values(), other.state_dict().values(), strict=True)
    )
    assert content["config"] == {"seed": 1}
    assert content["metrics"] == {"accuracy": 0.5}
    assert content["sha256"] == weights.digest(net.state_dict())


def test_load_into_other_net_names_the_tensors(saved):
    _, path = saved
    with pytest.raises(UserError, match=r"another net's weights: head.7.weight is \(4, 256\)"):
        weights.load_into(PointNetVanilla(5), path)
    with pytest.raises(UserError, match=r"weight is missing.*is unknown"):
        weights.load_into(nn.Linear(2, 2, bias=False), path)


@pytest.mark.parametrize("cut", [0, 10, 1000])
def test_read_truncated_file_is_refused(saved, cut):
    _, path = saved
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(
        UserError, match=r"weights\.pt is damaged or not a file .*expected a weights file"
    ):
        weights.read(path)


def test_read_changed_tensors_are_refused(saved):
    _, path = saved
    content = torch.load(path, weights_only=True)
    content["state"]["head.0.weight"][0, 0] += 1
    torch.save(content, path)
    with pytest.raises(UserError, match="damaged"):
        weights.read(path)


def test_read_missing_file_or_checkpoint_is_refused(tmp_path):
    with pytest.raises(UserError, match="no file"):
        weights.read(tmp_path / "nowhere.pt")
    torch.save({"state_dict": {}}, tmp_path / "last.ckpt")
    with pytest.raises(UserError, match=r"not a weights file of mops_lightning.*ckpt_path"):
        weights.read(tmp_path / "last.ckpt")


def test_half_precision_tensors_are_cast_to_the_modules_dtype(saved):
    _, path = saved
    content = torch.load(path, weights_only=True)
    state = content["state"]
    state["head.0.weight"] = state["head.0.weight"].half()
    state["head.3.weight"] = state["head.3.weight"].bfloat16()
    content["sha256"] = weights.digest(state)
    torch.save(content, path)
    net = PointNetVanilla(4)
    weights.load_into(net, path)
    loaded = net.state_dict()
    assert {value.dtype for value in net.parameters()} == {torch.float32}
    for name in ("head.0.weight", "head.3.weight"):
        assert state[name].dtype != torch.float32
        assert torch.equal(loaded[name], state[name].float())


def test_of_run_prefers_the_file_that_the_record_names(tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    assert weights.of_run(run) == run / "weights.pt"
    run_record.write(run, record(files={"weights": "../kept/net.pt"}))
    assert weights.of_run(run).resolve() == tmp_path / "kept" / "net.pt"


def rewrite(path, **changes):
    content = torch.load(path, weights_only=True) | changes
    torch.save({name: value for name, value in content.items() if value != "absent"}, path)


@pytest.mark.parametrize(
    "changes",
    [
        {"state": "absent"},
        {"state": [1, 2]},
        {"state": {"a": 1}},
        {"state": {1: torch.ones(1)}},
        {"state": {"a": torch.ones(2).to_sparse()}},
        {"state": {"a": torch.ones(2).to(torch.float8_e4m3fn)}},
        {"config": [1]},
        {"config": {"sampler": torch.ones(1)}},
        {"classes": 5},
        {"sha256": "absent"},
    ],
    ids=str,
)
def test_read_missing_or_other_parts_are_refused(saved, changes):
    _, path = saved
    rewrite(path, **changes)
    with pytest.raises(weights.Damaged, match="damaged"):
        weights.read(path)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_read_not_finite_is_refused(saved, value):
    net, path = saved
    with torch.no_grad():
        net.head[0].weight[3, 1] = value
    weights.save(path, net, {}, {})
    with pytest.raises(weights.Damaged, match=r"head\.0\.weight is not finite"):
        weights.load_into(PointNetVanilla(4), path)
