import pytest
import torch
from torch.testing import assert_close

from mops_lightning.nets.max_pool import GROUP, PLAIN_MAX_POINTS, PointMaxPool, blocked_argmax


class PlainMaxPool(PointMaxPool):
    """The same layers one after the other, with the full (B, N, C) tensor."""

    def forward(self, features):
        rows = self.linear(features.flatten(0, 1))
        if self.norm is not None:
            rows = self.norm(rows)
        values = rows.relu().unflatten(0, features.shape[:2])
        return values.amax(1)


def pools(channels_in=6, channels_out=20, norm=True):
    torch.manual_seed(1)
    fast = PointMaxPool(channels_in, channels_out, norm).double()
    if fast.norm is not None:
        with torch.no_grad():
            # A negative gamma turns the maximum into a minimum.
            fast.norm.weight.copy_(torch.randn(channels_out))
            fast.norm.bias.copy_(torch.randn(channels_out))
    plain = PlainMaxPool(channels_in, channels_out, norm).double()
    plain.load_state_dict(fast.state_dict())
    return fast, plain


@pytest.mark.parametrize("norm", [True, False])
@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("points", [4, PLAIN_MAX_POINTS, PLAIN_MAX_POINTS + 1, 50, 100])
def test_max_pool_equals_plain_layers(points, training, norm, randn):
    fast, plain = pools(norm=norm)
    features = randn(3, points, 6, dtype=torch.float64)
    direction = randn(3, 20, dtype=torch.float64)

    of_fast = results_of(fast, training, features, direction)
    of_plain = results_of(plain, training, features, direction)

    assert_close(of_fast, of_plain)
    assert_close(list(fast.buffers()), list(plain.buffers()))


def results_of(net, training, features, direction):
    """Return the output, the output of a net in evaluation, and all gradients."""
    net.train()
    net(features + 1)  # running statistics that differ from the initial ones
    net.train(training)
    inputs = features.clone().requires_grad_()
    out = net(inputs)
    gradients = torch.autograd.grad(out, [inputs, *net.parameters()], direction)
    net.eval()
    with torch.no_grad():  # the path without saved tensors
        out_without_gradient = net(features)
    return out, out_without_gradient, gradients


def test_max_pool_updates_statistics_with_the_momentum_of_its_norm(randn):
    fast, plain = pools()
    fast.norm.momentum = 0.4
    plain.norm.momentum = 0.4
    features = randn(3, 50, 6, dtype=torch.float64)

    fast(features)
    plain(features)

    assert_close(list(fast.buffers()), list(plain.buffers()))


def test_max_pool_frozen_passes_gradients_to_input(randn):
    fast, plain = pools()
    for net in (fast, plain):
        net.requires_grad_(False).eval()
    features = randn(2, 60, 6, dtype=torch.float64, requires_grad=True)

    gradient = torch.autograd.grad(fast(features).sum(), features)

    expected = torch.autograd.grad(plain(features).sum(), features)
    assert_close(gradient, expected)


def test_max_pool_ignores_padding(randn):
    # Padding copies of the first point can exceed it by a rounding error; many sizes hit this case.
    for number in range(PLAIN_MAX_POINTS + 1, PLAIN_MAX_POINTS + 40):
        pool = PlainMaxPool(6, 40).double().eval()
        features = randn(2, number, 6, dtype=torch.float64)
        features[:, 0] *= 5
        fast = PointMaxPool(6, 40).double().eval()
        fast.load_state_dict(pool.state_dict())
        features.requires_grad_()
        assert_close(fast(features), pool(features))


def test_blocked_argmax_of_ties_is_lowest_position(rng):
    values = torch.randint(0, 9, (50, 3 * GROUP), generator=rng).float()

    found = blocked_argmax(values)

    expected = []
    for row in values.tolist():
        lowest = row.index(max(row))
        expected.append([lowest])
    assert found.tolist() == expected
