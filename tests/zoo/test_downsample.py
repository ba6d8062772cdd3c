import numpy as np
import pytest
import torch

from mops_lightning import downsample, load
from mops_lightning.errors import UserError
from mops_lightning.zoo import publish
from mops_lightning.zoo.names import UNTRAINED
from tests.support.models import write_run

CLOUD = torch.rand(100, 3, generator=torch.Generator().manual_seed(0)) * 7


@pytest.mark.parametrize("method", UNTRAINED)
def test_untrained_methods_return_rows(method):
    points, indices = downsample(CLOUD, 10, method)
    assert torch.equal(points, CLOUD[indices])
    assert len(indices.unique()) == 10


def test_seed_and_start_are_used_and_fps_is_the_default():
    assert downsample(CLOUD, 5, "fps", start=42)[1][0] == 42
    first, second = (downsample(CLOUD, 5, "random", seed=seed)[1] for seed in (0, 1))
    assert not torch.equal(first, second)
    assert torch.equal(first, downsample(CLOUD, 5, "random")[1])
    assert torch.equal(downsample(CLOUD, 20)[1], downsample(CLOUD, 20, method="fps")[1])


@pytest.mark.parametrize("method", ["fps", "random", "serial", "voxel", "poisson"])
@pytest.mark.parametrize("other", [10, 25])
def test_rows_of_all_points_do_not_depend_on_the_clouds_beside(method, other):
    cloud = CLOUD[:10]
    clouds = [cloud, CLOUD[10 : 10 + other]]
    batch = torch.tensor([0] * 10 + [1] * other)

    _, alone = downsample(cloud, 10, method)

    _, of_list = downsample(clouds, 10, method)
    _, of_flat = downsample(torch.cat(clouds), 10, method, batch=batch)
    assert torch.equal(of_list[0], alone)
    assert torch.equal(of_flat[:10], alone)


def test_model_equals_its_sampler():
    points, indices = downsample(CLOUD.numpy(), 20, "fmops.modelnet40-m512")
    expected = load("fmops.modelnet40-m512").downsample(CLOUD, 20)
    assert np.array_equal(indices, expected[1].numpy())
    assert np.array_equal(points, expected[0].numpy())


def test_file_run_and_changed_file_are_loaded(tmp_path):
    write_run(tmp_path / "run")
    path = publish.add(tmp_path / "run", "fmops.mine", tmp_path)
    _, first = downsample(CLOUD, 8, path)
    assert torch.equal(downsample(CLOUD, 8, tmp_path / "run")[1], first)
    path.write_bytes(b"")
    with pytest.raises(UserError, match="damaged"):
        downsample(CLOUD, 8, path)


@pytest.mark.parametrize(
    ("method", "arguments", "words"),
    [
        ("fpss", {}, "method: unknown 'fpss'. Did you mean 'fps'"),
        ("fmops.modelnet", {}, "Did you mean .*'fmops.modelnet40-m512'"),
        ("nowhere/weights.safetensors", {}, "method: unknown"),
        ("pointnet.modelnet40", {}, "holds a task net"),
        ("random", {"start": 1}, "start is for method='fps'"),
        ("fps", {"start": 100}, "start must be less than the number of points N=100"),
        ("fps", {"start": -1}, "start must be at least 0"),
        ("mops.modelnet40-m32", {}, "m must be 32"),
    ],
)
def test_mistakes_are_one_line(method, arguments, words):
    with pytest.raises(UserError, match=words) as refused:
        downsample(CLOUD, 5, method, **arguments)
    assert "\n" not in str(refused.value)
