import pytest
import torch
from scipy.spatial import cKDTree

from mops_lightning.errors import UserError
from mops_lightning.losses.subset import subset_loss
from mops_lightning.ops import extreme
from mops_lightning.ops import nearest as search
from mops_lightning.ops.extreme import blocked_argextreme
from mops_lightning.ops.fps import farthest_point_fill, farthest_point_sample
from mops_lightning.ops.nearest import nearest
from mops_lightning.ops.points import gather_points, normalize_unit_sphere
from tests.support.plain import plain_farthest, plain_nearest, squared

FLOATS = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


@pytest.fixture(params=[0, extreme.FEW], ids=["in groups", "few"])
def few(request, monkeypatch):
    monkeypatch.setattr(extreme, "FEW", request.param)


BOTH = pytest.mark.usefixtures("few")
"""Small searches and large ones go different ways; here small ones go both."""


@BOTH
@FLOATS
@pytest.mark.parametrize("n", [5, 32, 75])
def test_nearest_equals_the_double_loop(n, dtype, rng):
    queries = torch.randn(2, 6, 3, dtype=dtype, generator=rng)
    points = torch.randn(2, n, 3, dtype=dtype, generator=rng)
    distances, indices = nearest(queries, points)
    expected, places = plain_nearest(queries, points)
    assert distances.dtype == dtype
    assert torch.equal(indices, places)
    torch.testing.assert_close(distances, expected)


def test_nearest_has_the_gradients_of_the_double_loop(rng):
    def gradients(function):
        leaves = [values.clone().requires_grad_() for values in (queries, points)]
        (function(*leaves)[0] * weights).sum().backward()
        return [leaf.grad for leaf in leaves]

    queries, points = torch.randn(2, 2, 9, 3, dtype=torch.float64, generator=rng)
    weights = torch.randn(2, 9, generator=rng)
    torch.testing.assert_close(gradients(nearest), gradients(plain_nearest))


def test_nearest_gradcheck(rng):
    queries, points = torch.randn(2, 2, 4, 3, dtype=torch.float64, generator=rng)
    leaves = (queries.requires_grad_(), points.requires_grad_())
    assert torch.autograd.gradcheck(lambda q, p: nearest(q, p)[0], leaves)


@pytest.mark.parametrize("block", [1, 100, 1000])
def test_nearest_in_blocks(block, rng, monkeypatch):
    queries = torch.randn(3, 11, 3, generator=rng)
    points = torch.randn(3, 40, 3, generator=rng)
    whole = nearest(queries, points)
    monkeypatch.setitem(search.BLOCK, "cpu", block)
    for part, expected in zip(nearest(queries, points), whole, strict=True):
        assert torch.equal(part, expected)


@pytest.mark.parametrize("offset", [0.0, 30.0])
def test_nearest_does_not_cancel(offset, rng):
    """Close points far from the origin, where |a|² + |b|² − 2⟨a, b⟩ in float32 goes wrong."""
    points = offset + 0.01 * torch.rand(2, 1500, 3, generator=rng)
    queries = points[:, :400] + 1e-4 * torch.randn(2, 400, 3, generator=rng)
    distances, indices = nearest(queries, points)
    for b in range(2):
        expected, _ = cKDTree(points[b].double().numpy()).query(queries[b].double().numpy())
        found = gather_points(points, indices)[b].double()
        exact = (queries[b].double() - found).norm(dim=1)
        torch.testing.assert_close(exact, torch.from_numpy(expected), rtol=1e-6, atol=0)
        torch.testing.assert_close(distances[b].double().sqrt(), exact, rtol=1e-5, atol=0)


@BOTH
def test_nearest_takes_the_lowest_of_equals():
    points = torch.tensor([[[1.0, 0, 0], [0, 1, 0], [0, 0, 0], [0, 0, 0]]]).repeat(1, 20, 1)
    assert nearest(torch.zeros(1, 1, 3), points)[1].item() == 2
    assert nearest(torch.tensor([[[1.0, 1, 0]]]), points)[1].item() == 0


def test_nearest_in_half_precision_chooses_in_single(rng):
    points = torch.randn(1, 50, 3, generator=rng).half()
    queries = torch.randn(1, 20, 3, generator=rng).half()
    distances, indices = nearest(queries, points)
    assert distances.dtype == torch.half
    assert torch.equal(indices, nearest(queries.float(), points.float())[1])


@pytest.mark.parametrize(
    ("queries", "points"), [((1, 4, 3), (2, 5, 3)), ((1, 4, 2), (1, 5, 3)), ((1, 4, 3), (1, 0, 3))]
)
def test_nearest_names_shapes_that_do_not_fit(queries, points):
    with pytest.raises(UserError, match="points"):
        nearest(torch.zeros(queries), torch.zeros(points))


@BOTH
@FLOATS
@pytest.mark.parametrize(("n", "m"), [(1, 1), (20, 20), (32, 7), (75, 30)])
def test_fps_equals_the_double_loop(n, m, dtype, rng):
    points = torch.randn(3, n, 3, dtype=dtype, generator=rng)
    start = torch.randint(n, (3,), generator=rng)
    indices = farthest_point_sample(points, m, start=start)
    assert indices.dtype == torch.int64
    for cloud, first, chosen in zip(points, start.tolist(), indices.tolist(), strict=True):
        assert chosen == plain_farthest(cloud, [first], m)


def test_fps_start(rng):
    points = torch.randn(4, 30, 3, generator=rng)
    assert farthest_point_sample(points, 3, start=7)[:, 0].tolist() == [7] * 4
    assert farthest_point_sample(points, 3)[:, 0].tolist() == [0] * 4

    def drawn(seed):
        generator = torch.Generator().manual_seed(seed)
        return farthest_point_sample(points, 3, generator=generator)

    assert torch.equal(drawn(1), drawn(1))
    assert not torch.equal(drawn(1)[:, 0], drawn(2)[:, 0])


@BOTH
def test_fps_of_coincident_points_is_distinct():
    points = torch.zeros(2, 40, 3)
    points[1, 10:20] = 1.0
    indices = farthest_point_sample(points, 40, start=3)
    assert indices.sort(1).values.tolist() == [list(range(40))] * 2
    assert indices[1, 1] == 10  # the lowest of the farthest


@pytest.mark.parametrize(("m", "start"), [(0, 0), (6, 0), (2, 5), (2, -1)])
def test_fps_names_what_is_out_of_range(m, start):
    with pytest.raises(UserError, match="m must be" if start == 0 else "start must be"):
        farthest_point_sample(torch.zeros(1, 5, 3), m, start=start)


@BOTH
def test_fill_equals_the_double_loop(rng):
    points = torch.randn(3, 45, 3, generator=rng)
    given = torch.tensor([1, 6, 12])
    indices = torch.stack([torch.randperm(45, generator=rng)[:12] for _ in range(3)])
    filled = farthest_point_fill(points, indices, given)
    for b in range(3):
        chosen = indices[b, : given[b]].tolist()
        assert filled[b].tolist() == plain_farthest(points[b], chosen, 12)


@BOTH
@pytest.mark.parametrize("largest", [True, False])
def test_first_extreme_is_the_lowest_position(largest, rng):
    values = torch.randint(0, 9, (50, 3 * extreme.GROUP), generator=rng).float()
    rows = values.tolist()
    expected = [row.index(max(row) if largest else min(row)) for row in rows]
    assert blocked_argextreme(values, largest).squeeze(1).tolist() == expected


def test_gather_points_equals_the_double_loop(rng):
    points = torch.randn(2, 7, 4, dtype=torch.float64, generator=rng, requires_grad=True)
    indices = torch.randint(7, (2, 5), generator=rng)
    gathered = gather_points(points, indices)
    for b in range(2):
        for j in range(5):
            assert torch.equal(gathered[b, j], points[b, indices[b, j]])
    assert torch.autograd.gradcheck(lambda p: gather_points(p, indices), (points,))


@FLOATS
def test_normalize_unit_sphere(dtype, rng):
    points = 5 + 3 * torch.randn(4, 20, 3, dtype=dtype, generator=rng)
    result = normalize_unit_sphere(points)
    assert result.dtype == dtype
    assert result.mean(1).abs().max() < 1e-6
    torch.testing.assert_close(result.norm(dim=2).amax(1), torch.ones(4, dtype=dtype))
    ratio = (points[:, 1:] - points[:, :1]) / (result[:, 1:] - result[:, :1])
    torch.testing.assert_close(ratio, ratio[:, :1, :1].expand_as(ratio), rtol=1e-3, atol=0)


def test_normalize_keeps_clouds_of_no_size_at_zero():
    points = torch.full((2, 10, 3), 0.1)
    points[1] = torch.randn(10, 3, generator=torch.Generator().manual_seed(0))
    points.requires_grad_()
    result = normalize_unit_sphere(points)
    assert (result[0] == 0).all()
    (gradient,) = torch.autograd.grad(result.square().sum(), points)
    assert torch.isfinite(gradient).all()


def test_normalize_gradcheck(rng):
    points = torch.randn(2, 6, 3, dtype=torch.float64, generator=rng, requires_grad=True)
    assert torch.autograd.gradcheck(normalize_unit_sphere, (points,))


def test_subset_loss_equals_the_paper_s_sum(rng):
    points = torch.randn(3, 12, 3, dtype=torch.float64, generator=rng)
    samples = torch.randn(3, 5, 3, dtype=torch.float64, generator=rng, requires_grad=True)
    expected = torch.tensor(0.0, dtype=torch.float64)
    for cloud, sample in zip(points, samples, strict=True):
        for q in sample:
            expected = expected + min(squared(q, p) for p in cloud) / 5 / 3
    loss = subset_loss(points, samples)
    torch.testing.assert_close(loss, expected)
    torch.testing.assert_close(
        torch.autograd.grad(loss, samples), torch.autograd.grad(expected, samples)
    )
    assert torch.autograd.gradcheck(lambda q: subset_loss(points, q), (samples,))
    assert subset_loss(points, points[:, 3:7]) == 0
