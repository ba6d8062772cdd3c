import itertools
import math
from statistics import mean

import pytest
import torch
from torch.testing import assert_close

from mops_lightning import FMOPSNet, MOPSNet
from tests.support.losses import subset_loss


def small(m_max=16, **settings):
    torch.manual_seed(0)
    return FMOPSNet(m_max, feature_channels=(8, 6), rho_channels=(12, 10), **settings)


def test_fmops_equals_mops_with_sliced_weights(randn):
    points = randn(3, 40, 3)
    flexible = small()
    fixed = MOPSNet(5, feature_channels=(8, 6), rho_channels=(12, 10))
    state = flexible.state_dict()
    state["queries.weight"] = state["queries.weight"][:5]
    fixed.load_state_dict(state, strict=True)

    of_fixed = fixed.eval()(points)
    of_flexible = flexible.eval()(points, 5)

    assert_close(of_fixed.points, of_flexible.points)


def test_fmops_sizes_share_one_forward_pass(randn):
    points = randn(3, 40, 3)
    net = small(alpha=2.0).train()
    calls = []

    def note_call(*_):
        calls.append(1)

    net.features.register_forward_hook(note_call)

    outputs = net.sample_sizes(points, (2, 16, 7))

    assert len(calls) == 1
    assert list(outputs) == [2, 16, 7]
    for m, output in outputs.items():
        assert output.points.shape[1] == m
        assert output.matrix.m == m
        expected = 2 * subset_loss(points, output.points)
        assert_close(output.losses["subset"], expected)


def drawn(number, m_max=512, **settings):
    net = small(m_max, **settings)
    torch.manual_seed(1)
    return [net.training_sizes() for _ in range(number)]


def test_uniform_training_sizes_have_documented_distribution():
    steps = drawn(4000, size_sampling="uniform")

    sizes = [size for (size,) in steps]
    assert min(sizes) == 1
    assert max(sizes) == 512
    assert mean(sizes) == pytest.approx(256.5, rel=0.03)


def share(condition):
    return condition.double().mean()


def parts_of(sizes):
    """Return the place of each size in its quarter of the range of logarithms up to 513."""
    return torch.tensor(sizes).log() / math.log(513) * 4


def test_nested_training_sizes_are_drawn_independently():
    steps = [sizes for sizes in drawn(2000, num_sizes=4) if len(sizes) == 4]

    third, fourth = parts_of(steps)[:, 2:].T
    correlation = torch.corrcoef(torch.stack([third, fourth]))[0, 1]
    assert abs(correlation) < 0.1


def test_single_training_sizes_have_documented_distribution():
    sizes = torch.tensor(drawn(4000, num_sizes=1))
    sizes_up_to_3 = torch.tensor(drawn(4000, 3, num_sizes=1))

    assert sizes.shape == (4000, 1)
    assert sizes.min() == 1
    assert 500 <= sizes.max() <= 512
    # floor(513^u) is m with the probability log((m + 1) / m) / log 513.
    assert share(sizes == 1) == pytest.approx(0.1111, abs=0.02)
    assert share(sizes <= 22) == pytest.approx(0.5025, abs=0.03)
    share_of_3 = math.log(4 / 3, 4)
    assert share(sizes_up_to_3 == 3) == pytest.approx(share_of_3, abs=0.02)


def test_nested_training_sizes_are_one_of_each_part():
    for sizes in drawn(300, num_sizes=4):
        assert list(sizes) == sorted(set(sizes))
        assert 1 <= sizes[0] <= 4
        assert 107 <= sizes[-1] <= 512
        # Neighbouring parts share a size at their boundary, which is then drawn once.
        assert len(sizes) in (3, 4)


def different_sizes(steps):
    return set(itertools.chain.from_iterable(steps))


@pytest.mark.parametrize("size_sampling", ["uniform", "nested"])
def test_training_sizes_begin_at_min_size(size_sampling):
    steps = drawn(2000, 32, size_sampling=size_sampling, num_sizes=2, min_size=8)
    below_min_size = small(4, size_sampling=size_sampling, min_size=8)
    of_one_point = small(1, size_sampling=size_sampling)
    of_three_points = drawn(99, 3, size_sampling=size_sampling, num_sizes=1)

    assert different_sizes(steps) == set(range(8, 33))
    assert set(below_min_size.training_sizes()) == {4}
    assert set(of_one_point.training_sizes()) == {1}
    assert different_sizes(of_three_points) <= {1, 2, 3}


def test_nested_training_sizes_split_the_range_from_min_size():
    for small_size, large_size in drawn(300, num_sizes=2, min_size=8):
        # The middle of the range of logarithms: sqrt(8 · 513) = 64.06.
        assert 8 <= small_size <= 64 <= large_size <= 512
