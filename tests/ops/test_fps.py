import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.ops.fps import farthest_point_fill, farthest_point_sample, fps
from tests.support.plain import plain_farthest


@pytest.mark.usefixtures("farthest_form")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("n", "m"), [(1, 1), (20, 20), (32, 7), (75, 30)])
def test_fps_equals_double_loop(n, m, dtype, rng):
    points = torch.randn(3, n, 3, dtype=dtype, generator=rng)
    start = torch.randint(n, (3,), generator=rng)
    indices = farthest_point_sample(points, m, start=start)
    assert indices.dtype == torch.int64
    for cloud, first, chosen in zip(points, start.tolist(), indices.tolist(), strict=True):
        assert chosen == plain_farthest(cloud, [first], m)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize(("n", "m"), [(1, 1), (37, 37), (1024, 512), (10_000, 40), (20_000, 9)])
@pytest.mark.parametrize("grid", [False, True])  # a grid has many ties and copies
def test_fps_on_a_gpu_is_that_of_a_cpu(n, m, grid, rng):
    points = torch.randn(3, n, 3, generator=rng)
    points = (4 * points).round() if grid else points
    start = torch.randint(n, (3,), generator=rng)
    on_gpu = farthest_point_sample(points.cuda(), m, start.cuda()).cpu()
    assert torch.equal(on_gpu, farthest_point_sample(points, m, start))


@pytest.mark.usefixtures("farthest_form")
@pytest.mark.parametrize(("n", "m"), [(1, 1), (20, 20), (75, 30), (3000, 9)])
def test_fps_multiplies_distances_by_weights(n, m, rng):
    points = torch.randn(3, n, 3, dtype=torch.float64, generator=rng)
    weight = torch.rand(3, n, generator=rng).square() * 100
    weight[:, : n // 4] = 0  # these are the last
    indices = farthest_point_sample(points, m, n - 1, weight)
    for cloud, part, chosen in zip(points, weight, indices.tolist(), strict=True):
        expected = plain_farthest(cloud, [n - 1], min(m, n - n // 4), part)
        assert chosen[: len(expected)] == expected
        assert len(set(chosen)) == m


def test_fps_equal_weights_change_nothing(rng):
    points = torch.randint(0, 9, (2, 5000, 3), generator=rng).float()  # many ties and copies
    weight = torch.full((2, 5000), 0.3)
    unweighted = farthest_point_sample(points, 400)
    assert torch.equal(farthest_point_sample(points, 400, weight=weight), unweighted)


def test_fps_start_is_given_or_zero(rng):
    points = torch.randn(4, 30, 3, generator=rng)
    assert farthest_point_sample(points, 3, start=7)[:, 0].tolist() == [7] * 4
    assert farthest_point_sample(points, 3)[:, 0].tolist() == [0] * 4


@pytest.mark.usefixtures("farthest_form")
def test_fps_of_coincident_points_is_distinct():
    points = torch.zeros(2, 40, 3)
    points[1, 10:20] = 1.0
    indices = farthest_point_sample(points, 40, start=3)
    assert indices.sort(1).values.tolist() == [list(range(40))] * 2
    assert indices[1, 1] == 10  # the lowest of the farthest


@pytest.mark.parametrize(("m", "start"), [(0, 0), (6, 0), (2, 5), (2, -1)])
def test_fps_out_of_range_raises(m, start):
    with pytest.raises(UserError, match="m must be" if start == 0 else "start must be"):
        farthest_point_sample(torch.zeros(1, 5, 3), m, start=start)


def test_fps_single_cloud_raises():
    with pytest.raises(UserError, match=r"points must have shape \(B, N, C\), got \(5, 3\)"):
        farthest_point_sample(torch.zeros(5, 3), 2)


@pytest.mark.usefixtures("farthest_form")
def test_fill_equals_double_loop(rng):
    points = torch.randn(3, 45, 3, generator=rng)
    given = torch.tensor([1, 6, 12])
    indices = torch.stack([torch.randperm(45, generator=rng)[:12] for _ in range(3)])
    filled = farthest_point_fill(points, indices, given)
    for b in range(3):
        chosen = indices[b, : given[b]].tolist()
        assert filled[b].tolist() == plain_farthest(points[b], chosen, 12)


def test_fill_of_points_with_gradients_equals_fill_without(rng):
    points = torch.randn(2, 40, 3, generator=rng)
    indices, given = torch.arange(10).expand(2, -1), torch.tensor([2, 5])
    filled = farthest_point_fill(points.clone().requires_grad_(), indices, given)
    assert torch.equal(filled, farthest_point_fill(points, indices, given))


def torch_cluster_fps(x, batch, ratio):
    """Choose farthest points as torch_cluster does: its loops, in plain torch."""
    chosen = []
    for cloud in batch.unique().tolist():
        rows = (batch == cloud).nonzero()[:, 0]
        points = x[rows].view(len(rows), -1)
        number = int((torch.tensor(float(len(rows))) * torch.tensor(ratio)).ceil())
        picked, distances = [0], (points - points[0]).pow(2).sum(1)
        for _ in range(number - 1):
            picked.append(int(distances.argmax()))
            distances = distances.min((points - points[picked[-1]]).pow(2).sum(1))
        chosen.append(rows[picked])
    return torch.cat(chosen)


@pytest.mark.parametrize("sizes", [(40,), (30, 30, 30), (50, 1, 0, 27)])
@pytest.mark.parametrize(("ratio", "shape"), [(0.1, (3,)), (0.5, ()), (1.0, (2, 2)), (0.3, (7,))])
def test_flat_fps_equals_torch_cluster(sizes, ratio, shape, rng):
    batch = torch.arange(len(sizes)).repeat_interleave(torch.tensor(sizes))
    x = torch.randn(len(batch), *shape, generator=rng)
    rows = fps(x, batch, ratio, random_start=False, batch_size=len(sizes) + 1)
    assert torch.equal(rows, torch_cluster_fps(x, batch, ratio))
    if len(sizes) == 1:
        assert torch.equal(rows, fps(x, ratio=ratio, random_start=False))


def test_ratio_of_each_cloud_is_its_own(rng):
    x, batch = torch.rand(60, 3, generator=rng), torch.arange(2).repeat_interleave(30)
    alone = [fps(x[i * 30 :][:30], None, r, False) + i * 30 for i, r in enumerate((0.1, 0.5))]
    assert torch.equal(fps(x, batch, torch.tensor([0.1, 0.5]), False), torch.cat(alone))


def test_random_start_differs_between_clouds_and_repeats_with_torch_seed():
    x, batch = torch.rand(600, 3), torch.arange(6).repeat_interleave(100)
    torch.manual_seed(3)
    starts = fps(x, batch, 0.01)
    assert batch[starts].tolist() == list(range(6))
    assert len((starts % 100).unique()) > 1
    torch.manual_seed(3)
    assert torch.equal(fps(x, batch, 0.01), starts)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"x": torch.zeros(0, 3)}, r"x must be a tensor .*\(0, 3\)"),
        ({"x": torch.rand(4, 3).numpy()}, "x must be a tensor"),
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
