from itertools import pairwise
from typing import Any

import pytest
import torch
from torch import nn
from torch.testing import assert_close

from mops_lightning.samplers.snet import SNet
from tests.support.losses import simplification_loss

FOR_RECONSTRUCTION: dict[str, Any] = {
    "feature_channels": (64, 128, 128, 256, 128),
    "head_channels": (256, 256),
    "head_norm": False,
    "output_norm": False,
}


@pytest.mark.parametrize(
    ("settings", "channels", "norms"),
    [
        ({}, [3, 64, 64, 64, 128, 128, 256, 256, 256, 96], 9),
        (FOR_RECONSTRUCTION, [3, 64, 128, 128, 256, 128, 256, 256, 96], 5),
    ],
)
def test_snet_has_published_layers(settings, channels, norms):
    parts = list(SNet(32, **settings).modules())
    layers = [tuple(m.weight.shape) for m in parts if isinstance(m, nn.Linear)]
    assert layers == [(b, a) for a, b in pairwise(channels)]
    assert sum(isinstance(m, nn.BatchNorm1d) for m in parts) == norms


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


def test_snet_equals_written_out_formulas(randn):
    net = SNet(6, feature_channels=(8, 11, 10), head_channels=(12, 9, 7)).double().train()
    points = randn(4, 20, 3, dtype=torch.float64)
    for _ in range(3):  # so that the running statistics differ from their initial values
        net(points)
    net.eval()
    assert_close(net(points).points, plain_snet(net, points))


def test_snet_loss_is_weighted_and_in_training_only(randn):
    net = SNet(6, alpha=3.0, coverage=0.5, coverage_per_point=0.25).train()
    points = randn(4, 20, 3)
    output = net(points)
    expected = 3 * simplification_loss(points, output.points, 0.5, 0.25)
    assert_close(output.losses["simplification"], expected)
    assert net.eval()(points).losses == {}
