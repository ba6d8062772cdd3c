import math

import pytest
import torch

from mops_lightning import FMOPSNet, MOPSNet
from tests.support.losses import subset_loss


def small(m_max=16, **settings):
    torch.manual_seed(0)
    return FMOPSNet(m_max, feature_channels=(8, 6), rho_channels=(12, 10), **settings)


def test_fmops_equals_mops_with_sliced_weights(rng):
    points = torch.randn(3, 40, 3, generator=rng)
    flexible = small()
    fixed = MOPSNet(5, feature_channels=(8, 6), rho_channels=(12, 10))
    state = flexible.state_dict()
    state["queries.weight"] = state["queries.weight"][:5]
    fixed.load_state_dict(state, strict=True)
    torch.testing.assert_close(fixed.eval()(points).points, flexible.eval()(points, 5).points)


def test_fmops_sizes_share_one_forward_pass(rng):
    points = torch.randn(3, 40, 3, generator=rng)
    net = small(alpha=2.0).train()
    calls = []
    net.features.register_forward_hook(lambda *_: calls.append(1))
    outputs = net.sample_sizes(points, (2, 16, 7))
    assert len(calls) == 1
    assert list(outputs) == [2, 16, 7]
    for m, output in outputs.items():
        assert output.points.shape[1] == len(output.matrix.queries) == m
        expected = 2 * subset_loss(points, output.points)
        torch.testing.assert_close(output.losses["subset"], expected)


def drawn(number, m_max=512, **settings):
    net = small(m_max, **settings)
    torch.manual_seed(1)
    return [net.training_sizes() for _ in range(number)]


def test_training_sizes_have_documented_distribution():
    uniform = torch.tensor(drawn(4000, size_sampling="uniform")).flatten().double()
    assert (uniform.min(), uniform.max()) == (1, 512)
    assert uniform.mean() == pytest.approx(256.5, rel=0.03)
    log = torch.tensor(drawn(4000, num_sizes=1))
    assert log.shape == (4000, 1)
    assert log.min() == 1
    assert 500 <= log.max() <= 512
    # floor(513^u) is m with the probability log((m + 1) / m) / log 513.
    assert (log == 1).double().mean() == pytest.approx(0.1111, abs=0.02)
    assert (log <= 22).double().mean() == pytest.approx(0.5025, abs=0.03)
    few = torch.tensor(drawn(4000, 3, num_sizes=1))
    assert (few == 3).double().mean() == pytest.approx(math.log(4 / 3, 4), abs=0.02)
    nested = drawn(300, num_sizes=4)
    assert all(list(sizes) == sorted(set(sizes)) for sizes in nested)
    assert all(1 <= sizes[0] <= 4 and 107 <= sizes[-1] <= 512 for sizes in nested)
    # Neighbouring parts share a size at their boundary, which is then drawn once.
    assert {len(sizes) for sizes in nested} <= {3, 4}


@pytest.mark.parametrize("size_sampling", ["uniform", "nested"])
def test_training_sizes_begin_at_min_size(size_sampling):
    sizes = drawn(2000, 32, size_sampling=size_sampling, num_sizes=2, min_size=8)
    assert {size for step in sizes for size in step} == set(range(8, 33))
    assert set(small(4, size_sampling=size_sampling, min_size=8).training_sizes()) == {4}
    assert set(small(1, size_sampling=size_sampling).training_sizes()) == {1}
    tiny = drawn(99, 3, size_sampling=size_sampling, num_sizes=1)
    assert {size for step in tiny for size in step} <= {1, 2, 3}


def test_nested_training_sizes_split_the_range_from_min_size():
    for small_size, large_size in drawn(300, num_sizes=2, min_size=8):
        # The middle of the range of logarithms: sqrt(8 · 513) = 64.06.
        assert 8 <= small_size <= 64 <= large_size <= 512
