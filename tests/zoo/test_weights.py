import pickle

import pytest
import torch
from torch import nn

from mops_lightning.data.clouds import CloudDataset, Clouds
from mops_lightning.errors import UserError
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.tasks.classification import Classification
from mops_lightning.tasks.segmentation import Segmentation
from mops_lightning.zoo import weights
from mops_lightning.zoo.outputs import check_names
from tests.support.models import rewrite


@pytest.fixture
def saved(tmp_path):
    net = PointNetVanilla(4)
    weights.save(tmp_path / weights.FILE, net, {"seed": 1}, {"accuracy": 0.5})
    return net, tmp_path / weights.FILE


def test_save_and_load_into_returns_equal_tensors_and_config(saved):
    net, path = saved
    other = PointNetVanilla(4)

    content = weights.load_into(other, path)

    loaded = other.state_dict()
    for name, value in net.state_dict().items():
        assert torch.equal(loaded[name], value), name
    assert content["config"] == {"seed": 1}
    assert content["metrics"] == {"accuracy": 0.5}
    assert content["sha256"] == weights.digest(net.state_dict())


def test_load_into_other_net_names_the_tensors(saved):
    _, path = saved
    with pytest.raises(UserError, match=r"another net's weights: .*head.7.weight.*4, 256"):
        weights.load_into(PointNetVanilla(5), path)
    with pytest.raises(UserError, match=r"Missing key.*weight.*Unexpected key"):
        weights.load_into(nn.Linear(2, 2, bias=False), path)


def test_save_shared_tensors_are_read(tmp_path):
    net = nn.ModuleList([nn.Linear(3, 3), nn.Linear(3, 3)])
    net[1].weight = net[0].weight
    weights.save(tmp_path / weights.FILE, net, {}, {})
    weights.load_into(net, tmp_path / weights.FILE)


@pytest.mark.parametrize("cut", [0, 10, 1000])
def test_read_truncated_file_is_refused(saved, cut):
    _, path = saved
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(weights.Damaged, match=r"weights\.safetensors is damaged or not a file"):
        weights.read(path)


def test_read_missing_file_or_checkpoint_is_refused(tmp_path):
    with pytest.raises(UserError, match="no file"):
        weights.read(tmp_path / "nowhere.safetensors")
    for save in (torch.save, lambda content, path: path.write_bytes(pickle.dumps(content))):
        save({"state_dict": {}}, tmp_path / "last.ckpt")
        with pytest.raises(weights.Damaged, match="not a file of this program"):
            weights.read(tmp_path / "last.ckpt")


def test_half_precision_tensors_are_cast_to_the_modules_dtype(saved):
    net, path = saved
    state = net.state_dict()
    rounded = {
        "head.0.weight": state["head.0.weight"].half(),
        "head.3.weight": state["head.3.weight"].bfloat16(),
    }
    rewrite(path, rounded)
    other = PointNetVanilla(4)

    weights.load_into(other, path)

    for name, value in other.named_parameters():
        assert value.dtype == torch.float32, name
    loaded = other.state_dict()
    for name, value in rounded.items():
        assert torch.equal(loaded[name], value.float())


@pytest.mark.parametrize(
    "changes",
    [
        {"config": [1]},
        {"metrics": "absent"},
        {"classes": 5},
        {"classes": [1]},
        {"sha256": "absent"},
        {"sha256": "0" * 64},
        {"schema": "mops_lightning/weights/1"},
        {"more": 1},
    ],
    ids=str,
)
def test_read_other_headers_are_refused(saved, changes):
    _, path = saved
    rewrite(path, **changes)
    with pytest.raises(weights.Damaged, match="damaged"):
        weights.read(path)


@pytest.mark.parametrize("dtype", [torch.int8, torch.uint8, torch.float8_e4m3fn], ids=str)
def test_read_quantised_tensors_are_refused(saved, dtype):
    net, path = saved
    weight = net.state_dict()["head.0.weight"]
    rewrite(path, {"head.0.weight": weight.to(dtype)})

    with pytest.raises(weights.Damaged, match=r"head\.0\.weight is quantised") as refused:
        weights.read(path)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e38])
def test_read_scales_that_are_not_finite_are_refused(value, saved):
    net, path = saved
    weight = torch.ones_like(net.state_dict()["head.0.weight"], dtype=torch.int8)
    scale = torch.full((len(weight), 1), value)
    rewrite(path, {"head.0.weight": weight * 127, "head.0.weight.scale": scale})
    with pytest.raises(weights.Damaged, match=r"head\.0\.weight(\.scale)? is not finite"):
        weights.read(path)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_read_not_finite_is_refused(saved, value):
    net, path = saved
    with torch.no_grad():
        net.head[0].weight[3, 1] = value
    weights.save(path, net, {}, {})
    with pytest.raises(weights.Damaged, match=r"head\.0\.weight is not finite"):
        weights.load_into(PointNetVanilla(4), path)


def test_names_of_classes_keep_the_order_of_the_outputs(tmp_path):
    path = tmp_path / weights.FILE
    weights.save(path, PointNetVanilla(3), {}, {}, ("vase", "bowl", "cup"))

    assert weights.read(path)["classes"] == ["vase", "bowl", "cup"]


@pytest.mark.parametrize("names", [("b", "a"), ("a", "b", "c"), ("a", "d")])
def test_net_of_other_classes_or_of_another_order_is_refused(names):
    clouds = Clouds(torch.rand(2, 8, 3), torch.tensor([0, 1]))
    dataset = CloudDataset(("a", "b"), clouds, clouds, "")
    task = Classification(PointNetVanilla(2), 2)

    check_names(["a", "b"], task, dataset, "net")
    with pytest.raises(UserError, match="classes, which are not the 2 classes of the data"):
        check_names(list(names), task, dataset, "net")


def test_joint_run_gives_its_task_net_and_another_run_what_it_trained(tmp_path):
    joint = tmp_path / "joint"
    alone = tmp_path / "alone"
    for folder in (joint, alone):
        folder.mkdir()
        (folder / weights.FILE).touch()
    (joint / "task_weights.safetensors").touch()

    assert weights.of_task_net(joint) == joint / "task_weights.safetensors"
    assert weights.of_task_net(alone) == alone / weights.FILE


@pytest.mark.parametrize(
    ("state", "name"),
    [
        ({"a": torch.ones(2), "b": torch.tensor([1.0, float("nan")])}, "b"),
        ({"a": {"b": [torch.ones(1), torch.tensor(float("inf"))]}}, "a.b.1"),
        ({"a": ({"b": torch.tensor(float("nan"))},)}, "a.0.b"),
        ({"a": {"b": [torch.ones(1)]}, "n": torch.tensor(3), "text": "nan", "f": 1.0}, None),
    ],
)
def test_first_nonfinite_names_a_tensor_in_nested_data(state, name):
    assert weights.first_nonfinite(state) == name


def test_digest_depends_on_names_shapes_types_and_values_but_not_on_order():
    state = {"a": torch.zeros(2, 3), "b": torch.ones(4)}
    same = {"b": torch.ones(4), "a": torch.zeros(2, 3)}
    others = [
        {"a": torch.zeros(3, 2), "b": torch.ones(4)},
        {"a": torch.zeros(2, 3), "c": torch.ones(4)},
        {"a": torch.zeros(2, 3, dtype=torch.int32), "b": torch.ones(4)},
        {"a": torch.zeros(2, 3), "b": torch.full((4,), 2.0)},
        {"a": torch.zeros(2, 3)},
    ]

    digests = {weights.digest(other) for other in (state, *others)}

    assert weights.digest(same) == weights.digest(state)
    assert len(digests) == 6


def test_truth_values_are_no_quantised_tensors(saved):
    net, path = saved
    net.register_buffer("mask", torch.tensor([True, False]))

    weights.save(path, net, {}, {})

    assert weights.read(path)["state"]["mask"].tolist() == [True, False]


def test_parts_of_another_net_are_called_parts():
    clouds = Clouds(torch.rand(2, 8, 3), torch.tensor([0, 1]))
    dataset = CloudDataset(("a",), clouds, clouds, "", part_names=("x", "y"))
    task = Segmentation(Shape(), 2)

    check_names(["x", "y"], task, dataset, "net")
    with pytest.raises(UserError, match="its net has 2 parts, which are not the 2 parts of the"):
        check_names(["y", "x"], task, dataset, "net")
    with pytest.raises(UserError, match="net does not name the parts of its net"):
        check_names(None, task, dataset, "net")


class Shape(nn.Module):
    def forward(self, points):
        return points[..., :2]
