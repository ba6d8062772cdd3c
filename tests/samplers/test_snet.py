import pytest
import torch
from torch import nn

from mops_lightning.errors import UserError
from mops_lightning.samplers.snet import SNet
from tests.support.losses import simplification_loss


def layers(net):
    return [tuple(m.weight.shape) for m in net.modules() if isinstance(m, nn.Linear)]


def test_snet_has_published_layers_for_classification():
    net = SNet(32)
    assert layers(net) == [
        (64, 3), (64, 64), (64, 64), (128, 64), (128, 128),
        (256, 128), (256, 256), (256, 256), (96, 256),
    ]  # fmt: skip
    assert sum(isinstance(m, nn.BatchNorm1d) for m in net.modules()) == 9


def test_snet_has_published_layers_for_reconstruction():
    net = SNet(
        32,
        feature_channels=(64, 128, 128, 256, 128),
        head_channels=(256, 256),
        head_norm=False,
        output_norm=False,
    )
    assert layers(net) == [
        (64, 3), (128, 64), (128, 128), (256, 128), (128, 256), (256, 128), (256, 256), (96, 256),
    ]  # fmt: skip
    assert sum(isinstance(m, nn.BatchNorm1d) for m in net.modules()) == 5


def plain_snet(net, points):
    """The formulas: linear layers with BatchNorm and ReLU, the maximum over points, the head."""
    linears = [m for m in net.modules() if isinstance(m, nn.Linear)]
    norms = [m for m in net.modules() if isinstance(m, nn.BatchNorm1d)]
    hidden = points
    for number, (linear, norm) in enumerate(zip(linears, norms, strict=True)):
        hidden = hidden @ linear.weight.mT + (0 if linear.bias is None else linear.bias)
        assert norm.running_var is not None
        scale = norm.weight / (norm.running_var + 1e-5).sqrt()
        hidden = (hidden - norm.running_mean) * scale + norm.bias
        if number < len(linears) - 1:
            hidden = hidden.clamp(min=0)
        if number == 2:  # the last pointwise layer
            hidden = hidden.max(1).values
    return hidden.reshape(len(points), -1, 3)


def test_snet_equals_written_out_formulas(rng):
    torch.manual_seed(0)
    net = SNet(6, feature_channels=(8, 11, 10), head_channels=(12, 9, 7)).double().train()
    points = torch.randn(4, 20, 3, generator=rng, dtype=torch.float64)
    for _ in range(3):  # so that the running statistics differ from their initial values
        net(points)
    net.eval()
    torch.testing.assert_close(net(points).points, plain_snet(net, points))


def test_snet_loss_is_weighted_and_in_training_only(rng):
    net = SNet(6, alpha=3.0, coverage=0.5, coverage_per_point=0.25).train()
    points = torch.randn(4, 20, 3, generator=rng)
    output = net(points)
    expected = 3 * simplification_loss(points, output.points, 0.5, 0.25)
    torch.testing.assert_close(output.losses["simplification"], expected)
    assert net.eval()(points).losses == {}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"alpha": -1.0}, "^alpha must be at least 0, got -1.0"),
        ({"alpha": float("nan")}, "^alpha must be at least 0, got nan"),
        ({"coverage": -1.0}, "^coverage must be at least 0"),
        ({"feature_channels": (8,)}, "^feature_channels must be sizes of at least 2 layers"),
        ({"head_channels": (0,)}, "^head_channels must be .* each at least 1, got .0."),
    ],
)
def test_snet_invalid_argument_raises(arguments, message):
    with pytest.raises(UserError, match=message):
        SNet(8, **arguments)
