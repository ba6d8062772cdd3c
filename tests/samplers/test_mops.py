import pytest
import torch
from torch import nn
from torch.testing import assert_close

from mops_lightning.losses.subset import overlap_losses
from mops_lightning.nets.layers import linear_norm_relu
from mops_lightning.samplers.mops import MOPSNet
from tests.support.losses import subset_loss


def small(m=5, **settings):
    torch.manual_seed(0)
    layers = {"feature_channels": (8, 6), "rho_channels": (12, 10)}
    return MOPSNet(m, **(layers | settings))


class PlainMOPS(nn.Module):
    """The network as published: repeated global feature, one ρ with bias, dense S."""

    def __init__(self, fast: MOPSNet) -> None:
        super().__init__()
        self.features = fast.features
        self.rho = self._joined_rho(fast)
        self.last = nn.Linear(fast.queries.weight.shape[1], fast.m)
        self.last.weight.data = fast.queries.weight.data
        self.tau = fast.tau

    @staticmethod
    def _joined_rho(fast):
        """Return ρ with a first layer that reads local and global features side by side."""
        channels = [2 * fast.rho_local.in_features, fast.rho_local.out_features]
        for layer in fast.rho:
            if isinstance(layer, nn.Linear):
                channels.append(layer.out_features)
        rho = linear_norm_relu(channels)
        first = torch.cat([fast.rho_local.weight, fast.rho_global.weight], 1)
        rho[0].weight.data = first.data
        rho[1].load_state_dict(fast.rho_first[0].state_dict())
        for number, layer in enumerate(fast.rho):
            rho[3 + number].load_state_dict(layer.state_dict())
        return rho

    def forward(self, points):
        local, global_ = self.features(points)
        repeated = global_[:, None].expand_as(local)
        joined = torch.cat([local, repeated], 2)
        flat = self.last(self.rho(joined.flatten(0, 1)))
        preliminary = flat.unflatten(0, points.shape[:2])
        matrix = (preliminary / self.tau).softmax(1)
        return matrix, matrix.mT @ points


@pytest.mark.parametrize("training", [True, False])
def test_mops_equals_published_form(training, randn):
    fast = small(tau_min=0.3).double().train(training)
    plain = PlainMOPS(fast).double().train(training)
    points = randn(3, 20, 3, dtype=torch.float64, requires_grad=True)
    direction = randn(3, 5, 3, dtype=torch.float64)

    output = fast(points)

    matrix, sampled = plain(points)
    # The plain twin has a bias in its last layer, which the softmax must cancel.
    assert plain.last.bias.abs().min() > 0
    assert_close(output.points, sampled)
    assert_close(output.matrix.dense(), matrix)
    shared = [points, *fast.features.parameters()]
    along = (output.points * direction).sum()
    gradients = torch.autograd.grad(along, [*shared, fast.queries.weight])
    plain_along = (sampled * direction).sum()
    expected = torch.autograd.grad(plain_along, [*shared, plain.last.weight])
    assert expected[0].abs().max() > 0
    assert expected[1].abs().max() > 0
    assert_close(gradients, expected)


def test_mops_has_published_layers():
    net = MOPSNet(32)

    sizes = [tuple(weights.shape) for weights in net.parameters() if weights.ndim == 2]

    assert sizes == [
        (64, 3),
        (64, 64),
        (64, 64),
        (128, 64),
        (128, 128),
        (512, 128),
        (512, 128),
        (256, 512),
        (128, 256),
        (32, 128),
    ]


def test_tau_decreases_exponentially_and_is_tau_min_in_evaluation():
    net = small(tau_min=0.1).train()
    taus = []
    for progress in (0.5, 1.0, 0.0):
        net.anneal(progress)
        taus.append(net.tau)
    assert taus == pytest.approx([0.1**0.5, 0.1, 1.0])
    assert net.eval().tau == 0.1
    assert net.train().tau == 1.0


def test_mops_loss_is_weighted_and_in_training_only(randn):
    net = small(alpha=7.0).train()
    points = randn(2, 20, 3)
    output = net(points)
    assert_close(output.losses["subset"], 7.0 * subset_loss(points, output.points))
    assert net.eval()(points).losses == {}


def test_mops_overlap_adds_weighted_penalty(randn):
    points = randn(3, 40, 3)
    without = small().train()
    net = small(overlap=4.0).train()

    losses_without = without(points).losses
    output = net(points)

    assert set(losses_without) == {"subset"}
    assert output.losses["subset"] == losses_without["subset"]
    penalties = overlap_losses(output.matrix, (5,))
    assert_close(output.losses["overlap"], 4 * penalties[5])


def test_mops_threshold_drops_small_entries_in_evaluation_only(randn):
    points = randn(2, 20, 3)
    net = small(tau_min=0.02, threshold=0.05).train()
    without = small(tau_min=0.02).train()

    in_training = net(points)
    in_evaluation = net.eval()(points)

    assert_close(in_training.points, without(points).points)
    matrix = in_evaluation.matrix.dense()
    kept = matrix.where(matrix >= 0.05, 0.0)
    assert (kept > 0).any(1).all()
    assert (kept == 0).any()
    renormalised = kept / kept.sum(1, keepdim=True)
    assert_close(in_evaluation.points, renormalised.mT @ points)
