import numpy as np
import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.transforms import Downsample


@pytest.fixture
def cloud():
    points = torch.rand(100, 3, generator=torch.Generator().manual_seed(0))
    return {"pos": points, "row": torch.arange(100), "names": np.arange(100), "label": 5}


def test_attributes_of_a_dictionary_follow_the_points(cloud):
    small = Downsample(10, method="fps")(cloud)
    rows = small["row"]
    assert torch.equal(small["pos"], cloud["pos"][rows])
    assert small["names"].tolist() == rows.tolist()
    assert small["label"] == 5
    assert len(cloud["pos"]) == 100


def test_named_attributes_only_follow(cloud):
    small = Downsample(10, method="fps", attributes=["names"])(cloud)
    assert (len(small["names"]), len(small["row"])) == (10, 100)


def test_arrays_under_another_key(cloud):
    data = {"xyz": cloud["pos"].numpy(), "row": cloud["row"]}
    small = Downsample(32, points="xyz")(data)
    assert np.array_equal(small["xyz"], data["xyz"][small["row"].numpy()])


def test_generated_points_have_no_attributes(cloud):
    transform = Downsample(32, "fmops.modelnet40-m512", readout="generated")
    assert transform({"pos": cloud["pos"]})["pos"].shape == (32, 3)
    with pytest.raises(UserError, match=r"'row' belongs to input points.*completed"):
        transform(cloud)


@pytest.mark.parametrize(
    ("arguments", "change", "words"),
    [
        ({}, {"pos": None}, "points must be a tensor"),
        ({"points": "xyz"}, {}, "points under 'xyz', got"),
        ({"attributes": ["x"]}, {}, "the data have no 'x'"),
        ({"attributes": ["label"]}, {}, "'label' must be an array or a tensor with a row"),
        ({"attributes": ["row"]}, {"row": torch.arange(99)}, "'row' must be an array"),
        ({}, {"pos": torch.rand(2, 9, 3)}, r"shape \(N, 3\), got \(2, 9, 3\)"),
        ({"method": "fp"}, {}, "Did you mean 'fps'"),
    ],
)
def test_mistakes_in_dictionaries_are_one_line(cloud, arguments, change, words):
    with pytest.raises(UserError, match=words):
        Downsample(10, **{"method": "fps", **arguments})({**cloud, **change})


@pytest.fixture
def geometric():
    """PyTorch Geometric's modules ``data`` and ``transforms``."""
    pytest.importorskip("torch_geometric", reason="torch_geometric is not installed")
    import torch_geometric.data
    import torch_geometric.transforms

    return torch_geometric


def test_node_attributes_of_pyg_data_follow(cloud, geometric):
    data = geometric.data.Data(pos=cloud["pos"], x=cloud["row"][:, None], y=torch.tensor([3]))
    transform = geometric.transforms.Compose([Downsample(10, method="fps")])
    small = transform(data)
    assert isinstance(Downsample(10), geometric.transforms.BaseTransform)
    assert torch.equal(small.pos, data.pos[small.x[:, 0]])
    assert (small.num_nodes, data.num_nodes, small.y.item()) == (10, 100, 3)


def test_pyg_batch_is_downsampled_cloud_by_cloud(cloud, geometric):
    items = [geometric.data.Data(pos=cloud["pos"][:n], row=torch.arange(n)) for n in (100, 60)]
    batch = geometric.data.Batch.from_data_list(items)
    small = Downsample(10, method="fps")(batch)
    assert small.batch.tolist() == [0] * 10 + [1] * 10
    for one, item in zip(small.to_data_list(), items, strict=True):
        assert torch.equal(one.pos, item.pos[one.row])


def test_pyg_batch_vector_gives_the_same_rows(cloud, geometric):
    from mops_lightning import downsample

    items = [geometric.data.Data(pos=cloud["pos"][:n], row=torch.arange(n)) for n in (100, 60)]
    batch = geometric.data.Batch.from_data_list(items)
    _, rows = downsample(batch.pos, 10, "fps", batch=batch.batch)
    small = Downsample(10, method="fps")(batch)
    assert torch.equal(batch.row[rows], small.row)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"pos": None}, "data must have points in pos"),
        ({"edge_index": torch.zeros(2, 4, dtype=torch.int64)}, "edge_index refers to points"),
        ({"face": torch.zeros(3, 4, dtype=torch.int64)}, "face refers to points"),
    ],
)
def test_mistakes_in_pyg_data_are_one_line(cloud, geometric, fields, words):
    data = geometric.data.Data(**{"pos": cloud["pos"], **fields})
    with pytest.raises(UserError, match=words):
        Downsample(10, method="fps")(data)
