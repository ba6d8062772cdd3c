import pytest
import torch

from mops_lightning.ops.attention import Partial, attend


def random_input(n, m, c=8, seed=0):
    rng = torch.Generator().manual_seed(seed)
    return tuple(torch.randn(*shape, generator=rng) for shape in ((m, c), (n, c), (n, 3)))


def plain_attend(queries, keys, values):
    logits = queries.double() @ keys.double().mT
    return logits.softmax(1) @ values.double()


def test_attend_equals_softmax(rng):
    queries = torch.randn(600, 8, generator=rng, dtype=torch.float64) * 5
    keys = torch.randn(2100, 8, generator=rng, dtype=torch.float64) * 5
    values = torch.randn(2100, 3, generator=rng, dtype=torch.float64)
    found = attend(queries, keys, values)
    assert isinstance(found, Partial)
    torch.testing.assert_close(found.result(), (queries @ keys.mT).softmax(1) @ values)


@pytest.mark.parametrize("height", [-50.0, 30.0, 100.0, 3e4])
def test_attend_outlier_between_probes_equals_softmax(height):
    queries, keys, points = random_input(n=3000, m=5)
    # Rows 1 and 2 are not probes, which are about 46 rows apart and start with row 0.
    keys[1] = queries[3] * height / queries[3].square().sum()
    keys[2] = keys[1] * 0.999
    found = attend(queries, keys, points)
    want = plain_attend(queries, keys, points)
    torch.testing.assert_close(found.result().double(), want, rtol=1e-4, atol=1e-5)
    parts = [
        attend(queries, keys[rows], points[rows])
        for rows in (slice(0, 1), slice(1, 2), slice(2, 3000))
    ]
    merged = parts[0].merge(parts[1]).merge(parts[2])
    torch.testing.assert_close(merged.result(), found.result(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_attend_half_precision_does_not_overflow(dtype):
    queries, keys, points = random_input(n=3000, m=50)
    queries, keys, points = queries.to(dtype) / 0.2, keys.to(dtype), points.to(dtype)
    found = attend(queries, keys, points)
    logits = queries.double() @ keys.double().mT
    digits = float(logits.abs().max()) * torch.finfo(dtype).eps
    want = plain_attend(queries, keys, points)
    torch.testing.assert_close(found.result().double(), want, rtol=0, atol=2 * digits)


def test_attend_huge_logits_stay_in_range_of_values():
    queries, keys, points = random_input(n=1500, m=300, c=257)
    found = attend(queries * 1e8, keys.relu(), points)
    # Logits of 1e9 are multiples of about 100, so the winner is arbitrary, but must be a point.
    assert found.result().abs().max() <= points.abs().max() * 1.001
    assert found.total.min() >= 0.5


def test_attend_many_points_keep_precision(rng):
    queries, keys = torch.zeros(3, 4), torch.zeros(300_000, 4)
    values = torch.rand(300_000, 3, generator=rng)
    found = attend(queries, keys, values).result()
    expected = values.double().mean(0).float().expand(3, 3)
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=0)
