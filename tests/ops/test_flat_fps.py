import subprocess
import sys

import numpy as np
import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.ops.flat_fps import _on_device, fps
from mops_lightning.ops.fps import farthest_point_sample


def torch_cluster_fps(x, batch, ratio):
    """Choose farthest points as torch_cluster does: its loops, in plain torch."""
    chosen = []
    for cloud in batch.unique():
        (rows,) = torch.where(batch == cloud)
        points = x[rows].view(len(rows), -1)
        size = torch.tensor(float(len(rows)))
        number = int((size * torch.tensor(ratio)).ceil())
        picked = [0]
        distances = (points - points[0]).pow(2).sum(1)
        for _ in range(number - 1):
            farthest = int(distances.argmax())
            picked.append(farthest)
            to_farthest = (points - points[farthest]).pow(2).sum(1)
            distances = distances.min(to_farthest)
        chosen.append(rows[picked])
    return torch.cat(chosen)


@pytest.mark.parametrize(
    "sizes",
    [
        (40,),
        (30, 30, 30),
        (50, 1, 0, 27),
    ],
)
@pytest.mark.parametrize(
    ("ratio", "shape"),
    [
        (0.1, (3,)),
        (0.5, ()),
        (1.0, (2, 2)),
        (0.3, (7,)),
    ],
)
def test_flat_fps_equals_torch_cluster(sizes, ratio, shape, randn):
    number = len(sizes)
    batch = torch.arange(number).repeat_interleave(torch.tensor(sizes))
    x = randn(len(batch), *shape)

    rows = fps(x, batch, ratio, random_start=False, batch_size=number + 1)
    rows_of_all = fps(x, batch, ratio, random_start=False, batch_size=number)

    assert torch.equal(rows_of_all, rows)
    assert torch.equal(rows, torch_cluster_fps(x, batch, ratio))
    if number == 1:
        without_batch = fps(x, ratio=ratio, random_start=False)
        assert torch.equal(rows, without_batch)


@pytest.mark.parametrize("sizes", [(40,), (30, 30), (50, 1, 0, 27)])
@pytest.mark.parametrize("kind", ["floats", "whole numbers", "without channels"])
def test_flat_fps_in_the_form_for_gpus_equals_that_for_cpus(sizes, kind, randn):
    counts = np.array(sizes)
    starts = np.maximum(counts - 1, 0)
    numbers = np.ceil(0.3 * counts).astype(np.int64)
    x = randn(int(counts.sum()), 3)
    if kind == "whole numbers":
        x = (1000 * x).long()
    elif kind == "without channels":
        x = x[:, 0]

    rows = _on_device(x, counts, numbers, starts)

    expected = []
    begin = 0
    for count, number in zip(sizes, numbers.tolist(), strict=True):
        if count > 0:
            cloud = x[begin : begin + count].double().view(1, count, -1)
            (of_cloud,) = farthest_point_sample(cloud, number, start=count - 1)
            expected.append(of_cloud + begin)
        begin += count
    assert torch.equal(rows, torch.cat(expected))


def test_flat_fps_in_the_form_for_gpus_refuses_points_that_are_not_finite():
    one = np.array([1])

    with pytest.raises(UserError, match="x must be finite, got NaN or infinity"):
        _on_device(torch.full((1, 3), torch.nan), one, one, one - 1)


def test_ratio_of_each_cloud_is_its_own(rand):
    first = rand(30, 3)
    second = rand(30, 3)
    x = torch.cat([first, second])
    batch = torch.arange(2).repeat_interleave(30)
    ratios = torch.tensor([0.1, 0.5])

    rows = fps(x, batch, ratios, random_start=False)

    of_first = fps(first, ratio=0.1, random_start=False)
    of_second = fps(second, ratio=0.5, random_start=False)
    assert torch.equal(rows, torch.cat([of_first, of_second + 30]))


def test_random_start_differs_between_clouds_and_repeats_with_torch_seed():
    x, batch = torch.rand(600, 3), torch.arange(6).repeat_interleave(100)
    torch.manual_seed(3)
    starts = fps(x, batch, 0.01)
    assert batch[starts].tolist() == list(range(6))
    assert len((starts % 100).unique()) > 1
    torch.manual_seed(3)
    assert torch.equal(fps(x, batch, 0.01), starts)


def test_random_start_of_a_large_cloud_beside_small_ones_may_be_any_of_its_points():
    sizes = [2] + [1000] * 8
    batch = torch.arange(9).repeat_interleave(torch.tensor(sizes))
    x = torch.rand(len(batch), 3)
    torch.manual_seed(0)

    starts = fps(x, batch, 0.001)

    rows_in_clouds = (starts[1:] - 2) % 1000
    assert rows_in_clouds.min() < 500 < rows_in_clouds.max()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"x": torch.zeros(0, 3)}, r"x must be a tensor or an array .*\(0, 3\)"),
        ({"x": [[1.0, 2.0], [3.0, 4.0]]}, "x must be a tensor or an array"),
        ({"x": torch.full((4, 3), torch.nan)}, "x must be finite"),
        ({"ratio": torch.tensor([0.5, 0.5])}, "one or one per cloud"),
        ({"ratio": 0.0}, "ratio must be above 0 and at most 1"),
        ({"ratio": 1.5}, "ratio must be above 0 and at most 1"),
        ({"batch": torch.tensor([0, 1, 0, 0])}, "must be ascending"),
        ({"batch": torch.tensor([0, 1])}, r"shape \(P=4,\)"),
        ({"batch": torch.zeros(4)}, "batch must be whole numbers"),
        ({"batch": torch.tensor([0, 0, 1, 1]), "batch_size": 1}, "batch_size must be at least 2"),
    ],
)
def test_fps_of_wrong_arguments_raises(arguments, said):
    with pytest.raises(UserError, match=said):
        fps(**{"x": torch.rand(4, 3), **arguments})


def exact_farthest(cloud, m):
    """Choose farthest points from row 0 in float64, the lowest row in case of ties."""
    cloud = cloud.astype(np.float64)
    rows = [0]
    gaps = np.full(len(cloud), np.inf)
    while len(rows) < m:
        gaps = np.minimum(gaps, ((cloud - cloud[rows[-1]]) ** 2).sum(1))
        rows.append(int(gaps.argmax()))
    return rows


def steps_of_a_centimetre():
    return np.random.default_rng(0).integers(0, 300, (2000, 3)) / 100


def grid_of_tenths():
    return np.stack(np.meshgrid(*[np.arange(13) * 0.1] * 3), -1).reshape(-1, 3)


def repeated_points():
    return np.repeat(np.random.default_rng(0).random((50, 3)), 20, 0)


def map_coordinates():
    return np.random.default_rng(0).random((2000, 3)) * 2 + [500_000, 4_500_000, 100]


def whole_numbers():
    return np.random.default_rng(0).integers(-20, 20, (1500, 3))


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, np.int32])
@pytest.mark.parametrize(
    ("cloud", "m"),
    [
        (steps_of_a_centimetre, 600),
        (grid_of_tenths, 440),
        (repeated_points, 50),
        (map_coordinates, 64),
        (whole_numbers, 500),
    ],
)
def test_fps_of_near_ties_is_that_of_float64_arithmetic(cloud, m, dtype):
    if dtype == np.float16 and cloud is map_coordinates:
        pytest.skip("beyond the numbers of half precision")
    points = cloud().astype(dtype)
    number = min(m, len(np.unique(points, axis=0)))

    rows = fps(points, ratio=(number - 0.5) / len(points), random_start=False)

    assert rows.tolist() == exact_farthest(points, number)


def test_fps_of_an_array_is_that_of_a_tensor(randn):
    x = randn(90, 3)
    batch = torch.arange(3).repeat_interleave(torch.tensor([40, 20, 30]))

    of_array = fps(x.numpy(), batch.numpy(), 0.3, random_start=False)

    assert isinstance(of_array, np.ndarray)
    assert of_array.tolist() == fps(x, batch, 0.3, random_start=False).tolist()


def test_fps_of_an_array_repeats_with_numpy_seed():
    x = np.random.default_rng(0).random((500, 3))
    np.random.seed(4)  # noqa: NPY002  the generator that users seed
    first = fps(x, ratio=0.1)
    np.random.seed(4)  # noqa: NPY002

    assert fps(x, ratio=0.1).tolist() == first.tolist()


def test_fps_of_whole_numbers_chooses_half():
    whole = torch.tensor([[0, 0, 0], [4, 0, 0], [1, 0, 0], [9, 0, 0]])

    assert fps(whole, ratio=0.5, random_start=False).tolist() == [0, 3]


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_fps_number_of_points_is_that_of_pyg_lib(dtype):
    x = torch.arange(2000, dtype=torch.float32)[:, None].to(dtype)

    rows = fps(x, ratio=0.1, random_start=False)

    assert len(rows) == 200  # in half precision 0.1 is below 0.1, and 0.3 above 0.3


def test_fps_number_of_points_is_rounded_in_single_precision():
    x = torch.arange(70.0)

    rows = fps(x, ratio=0.1, random_start=False)

    assert len(rows) == 7  # in double precision, 0.1 · 70 is above 7


def test_fps_of_large_whole_numbers_is_exact():
    x = np.array([[0], [2**24], [2**24 + 1]])  # the last two are equal in single precision

    rows = fps(x, ratio=0.5, random_start=False)

    assert rows.tolist() == [0, 2]


def test_fps_of_bfloat16_is_that_of_its_numbers(randn):
    x = randn(50, 3).bfloat16()

    rows = fps(x, ratio=0.4, random_start=False)

    assert torch.equal(rows, fps(x.double(), ratio=0.4, random_start=False))


def test_fps_takes_truth_values_for_two_clouds(rand):
    x = rand(20, 3)
    is_second = torch.arange(20) >= 8

    rows = fps(x, is_second, 0.5, random_start=False)

    assert torch.equal(rows, fps(x, is_second.long(), 0.5, random_start=False))


def test_fps_of_an_array_does_not_import_torch():
    code = (
        "import sys, numpy as np; from mops_lightning import fps; "
        "fps(np.zeros((9, 3)), random_start=False); assert 'torch' not in sys.modules"
    )

    subprocess.run([sys.executable, "-c", code], check=True)
