import pytest
import torch

pytest.importorskip("torch_geometric", reason="torch_geometric is not installed")

from torch_geometric.data import Batch, Data
from torch_geometric.transforms import BaseTransform, Compose

from mops_lightning.errors import UserError
from mops_lightning.transforms import Downsample


@pytest.fixture
def cloud():
    points = torch.rand(100, 3, generator=torch.Generator().manual_seed(0))
    return Data(pos=points, x=torch.arange(100)[:, None], y=torch.tensor([3]))


@pytest.fixture
def clouds(cloud):
    return [Data(pos=cloud.pos[:n], row=torch.arange(n)) for n in (100, 60)]


def test_node_attributes_follow(cloud):
    small = Compose([Downsample(10, method="fps")])(cloud)
    assert isinstance(Downsample(10), BaseTransform)
    assert torch.equal(small.pos, cloud.pos[small.x[:, 0]])
    assert (small.num_nodes, cloud.num_nodes, small.y.item()) == (10, 100, 3)


def test_batch_is_downsampled_cloud_by_cloud(clouds):
    small = Downsample(10, method="fps")(Batch.from_data_list(clouds))
    assert small.batch.tolist() == [0] * 10 + [1] * 10
    for one, item in zip(small.to_data_list(), clouds, strict=True):
        assert torch.equal(one.pos, item.pos[one.row])


def test_generated_points_have_no_attributes(cloud):
    transform = Downsample(32, "fmops.modelnet40-m512", readout="generated")
    assert transform(Data(pos=cloud.pos)).pos.shape == (32, 3)
    with pytest.raises(UserError, match=r"'x' belongs to input points.*completed"):
        transform(cloud)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"pos": None}, "data must have points in pos"),
        ({"edge_index": torch.zeros(2, 4, dtype=torch.int64)}, "edge_index refers to points"),
        ({"face": torch.zeros(3, 4, dtype=torch.int64)}, "face refers to points"),
    ],
)
def test_mistakes_are_one_line(cloud, fields, words):
    with pytest.raises(UserError, match=words):
        Downsample(10, method="fps")(Data(**{"pos": cloud.pos, **fields}))
