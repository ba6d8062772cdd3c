import pytest
import torch
from torch.testing import assert_close

from mops_lightning.ops.attention import Partial, attend


def random_input(n, m, c=8, seed=0):
    rng = torch.Generator().manual_seed(seed)
    queries = torch.randn(m, c, generator=rng)
    keys = torch.randn(n, c, generator=rng)
    values = torch.randn(n, 3, generator=rng)
    return queries, keys, values


def plain_attend(queries, keys, values):
    logits = queries.double() @ keys.double().mT
    return logits.softmax(1) @ values.double()


def test_attend_equals_softmax(randn):
    queries = randn(600, 8, dtype=torch.float64) * 5
    keys = randn(2100, 8, dtype=torch.float64) * 5
    values = randn(2100, 3, dtype=torch.float64)

    found = attend(queries, keys, values)

    expected = plain_attend(queries, keys, values)
    assert isinstance(found, Partial)
    assert_close(found.result(), expected)


@pytest.fixture(params=[-50.0, 30.0, 100.0, 3e4])
def with_outlier(request):
    """Queries, keys and values, of which two keys are far from all others."""
    queries, keys, values = random_input(n=3000, m=5)
    direction = queries[3] / queries[3].square().sum()
    # Rows 1 and 2 are not probes, which are about 46 rows apart and start with row 0.
    keys[1] = request.param * direction
    keys[2] = keys[1] * 0.999
    return queries, keys, values


def test_attend_outlier_between_probes_equals_softmax(with_outlier):
    queries, keys, values = with_outlier

    found = attend(queries, keys, values).result()

    expected = plain_attend(queries, keys, values)
    assert_close(found.double(), expected, rtol=1e-4, atol=1e-5)


def test_attend_merges_parts_with_an_outlier(with_outlier):
    queries, keys, values = with_outlier
    whole = attend(queries, keys, values).result()

    first = attend(queries, keys[:1], values[:1])
    outlier = attend(queries, keys[1:2], values[1:2])
    rest = attend(queries, keys[2:], values[2:])
    merged = first.merge(outlier).merge(rest).result()

    assert_close(merged, whole, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_attend_half_precision_does_not_overflow(dtype):
    queries, keys, values = random_input(n=3000, m=50)
    queries = queries.to(dtype) / 0.2
    keys = keys.to(dtype)
    values = values.to(dtype)

    found = attend(queries, keys, values).result()

    logits = queries.double() @ keys.double().mT
    largest_logit = logits.abs().max().item()
    rounding = largest_logit * torch.finfo(dtype).eps
    expected = plain_attend(queries, keys, values)
    assert_close(found.double(), expected, rtol=0, atol=2 * rounding)


def test_attend_huge_logits_stay_in_range_of_values():
    queries, keys, points = random_input(n=1500, m=300, c=257)

    found = attend(queries * 1e8, keys.relu(), points)

    # Logits of 1e9 are multiples of about 100, so the winner is arbitrary, but must be a point.
    largest_coordinate = points.abs().max()
    assert found.result().abs().max() <= largest_coordinate * 1.001
    assert found.total.min() >= 0.5


def test_attend_many_points_keep_precision(rand):
    queries = torch.zeros(3, 4)
    keys = torch.zeros(300_000, 4)
    values = rand(300_000, 3)

    found = attend(queries, keys, values).result()

    mean = values.double().mean(0)
    expected = mean.float().expand(3, 3)
    assert_close(found, expected, rtol=1e-6, atol=0)
