import pytest
import torch
from torch import nn

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
        local = fast.rho_local.weight.shape[1]
        rho = linear_norm_relu([2 * local, *(m.out_features for m in self._linears(fast))])
        rho[0].weight.data = torch.cat([fast.rho_local.weight, fast.rho_global.weight], 1).data
        rho[1].load_state_dict(fast.rho_first[0].state_dict())
        for number, layer in enumerate(fast.rho):
            rho[3 + number].load_state_dict(layer.state_dict())
        self.rho = rho
        self.last = nn.Linear(fast.queries.weight.shape[1], fast.m)
        self.last.weight.data = fast.queries.weight.data
        self.tau = fast.tau

    @staticmethod
    def _linears(fast):
        return [fast.rho_local, *(m for m in fast.rho if isinstance(m, nn.Linear))]

    def forward(self, points):
        local, global_ = self.features(points)
        joined = torch.cat([local, global_[:, None].expand_as(local)], 2)
        preliminary = self.last(self.rho(joined.flatten(0, 1))).unflatten(0, points.shape[:2])
        matrix = (preliminary / self.tau).softmax(1)
        return matrix, matrix.mT @ points


@pytest.mark.parametrize("training", [True, False])
def test_mops_equals_published_form(training, rng):
    fast = small(tau_min=0.3).double().train(training)
    plain = PlainMOPS(fast).double().train(training)
    points = torch.randn(3, 20, 3, dtype=torch.float64, generator=rng, requires_grad=True)
    matrix, sampled = plain(points)
    output = fast(points)
    # The plain twin has a bias in its last layer, which the softmax must cancel.
    assert plain.last.bias.abs().min() > 0
    torch.testing.assert_close(output.points, sampled)
    torch.testing.assert_close(output.matrix.dense(), matrix)
    weights = torch.randn(3, 5, 3, dtype=torch.float64, generator=rng)
    shared = [points, *fast.features.parameters()]
    got = torch.autograd.grad((output.points * weights).sum(), [*shared, fast.queries.weight])
    want = torch.autograd.grad((sampled * weights).sum(), [*shared, plain.last.weight])
    assert all(gradient.abs().max() > 0 for gradient in want[:2])
    torch.testing.assert_close(got, want)


def test_mops_has_published_layers():
    net = MOPSNet(32)
    sizes = [tuple(p.shape) for name, p in net.named_parameters() if p.ndim == 2]
    features = [(64, 3), (64, 64), (64, 64), (128, 64), (128, 128)]
    assert sizes == [*features, (512, 128), (512, 128), (256, 512), (128, 256), (32, 128)]


def test_tau_decreases_exponentially_and_is_tau_min_in_evaluation():
    net = small(tau_min=0.1).train()
    taus = []
    for progress in (0.5, 1.0, 0.0):
        net.anneal(progress)
        taus.append(net.tau)
    assert taus == pytest.approx([0.1**0.5, 0.1, 1.0])
    assert net.eval().tau == 0.1
    assert net.train().tau == 1.0


def test_mops_loss_is_weighted_and_in_training_only(rng):
    net = small(alpha=7.0).train()
    points = torch.randn(2, 20, 3, generator=rng)
    output = net(points)
    torch.testing.assert_close(output.losses["subset"], 7.0 * subset_loss(points, output.points))
    assert net.eval()(points).losses == {}


def test_mops_overlap_adds_weighted_penalty(rng):
    points = torch.randn(3, 40, 3, generator=rng)
    plain, net = small().train(), small(overlap=4.0).train()
    assert set(plain(points).losses) == {"subset"}
    output = net(points)
    assert output.losses["subset"] == plain(points).losses["subset"]
    expected = 4 * overlap_losses(output.matrix, (5,))[5]
    torch.testing.assert_close(output.losses["overlap"], expected)


def test_mops_threshold_drops_small_entries_in_evaluation_only(rng):
    points = torch.randn(2, 20, 3, generator=rng)
    net, dense = small(tau_min=0.02, threshold=0.05), small(tau_min=0.02)
    torch.testing.assert_close(net.train()(points).points, dense.train()(points).points)
    output = net.eval()(points)
    matrix = output.matrix.dense()
    kept = matrix * (matrix >= 0.05)
    assert (kept > 0).any(1).all()
    assert (kept == 0).any()
    kept = kept / kept.sum(1, keepdim=True)
    torch.testing.assert_close(output.points, kept.mT @ points)
