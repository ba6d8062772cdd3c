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
    ("settings", "channels", "norms", "biases"),
    [
        ({}, [3, 64, 64, 64, 128, 128, 256, 256, 256, 96], 9, 0),
        (FOR_RECONSTRUCTION, [3, 64, 128, 128, 256, 128, 256, 256, 96], 5, 3),
    ],
)
def test_snet_has_published_layers(settings, channels, norms, biases):
    net = SNet(32, **settings)

    sizes = []
    for layer in modules_of(net, nn.Linear):
        sizes.append((layer.in_features, layer.out_features))
    assert sizes == list(pairwise(channels))
    assert len(modules_of(net, nn.BatchNorm1d)) == norms
    with_bias = [layer for layer in modules_of(net, nn.Linear) if layer.bias is not None]
    assert len(with_bias) == biases  # where there is no BatchNorm


def modules_of(net, kind):
    return [module for module in net.modules() if isinstance(module, kind)]


def plain_snet(net, points):
    """The formulas: linear layers with BatchNorm and ReLU, the maximum over points, the head."""
    linears = modules_of(net, nn.Linear)
    norms = modules_of(net, nn.BatchNorm1d)
    hidden = points
    for number, (linear, norm) in enumerate(zip(linears, norms, strict=True)):
        hidden = hidden @ linear.weight.mT
        if linear.bias is not None:
            hidden = hidden + linear.bias
        deviation = (norm.running_var + 1e-5).sqrt()
        hidden = (hidden - norm.running_mean) / deviation
        hidden = norm.weight * hidden + norm.bias
        if number < len(linears) - 1:
            hidden = hidden.clamp(min=0)
        if number == 2:  # the last pointwise layer
            hidden = hidden.amax(1)
    return hidden.reshape(len(points), -1, 3)


def test_snet_equals_written_out_formulas(randn):
    net = SNet(6, feature_channels=(8, 11, 10), head_channels=(12, 9, 7)).double().train()
    points = randn(4, 20, 3, dtype=torch.float64)
    for _ in range(3):  # so that the running statistics differ from their initial values
        net(points)
    net.eval()

    generated = net(points).points

    assert_close(generated, plain_snet(net, points))


def test_snet_loss_is_weighted_and_in_training_only(randn):
    net = SNet(6, alpha=3.0, coverage=0.5, coverage_per_point=0.25).train()
    points = randn(4, 20, 3)

    in_training = net(points)
    in_test = net.eval()(points)

    expected = 3 * simplification_loss(points, in_training.points, 0.5, 0.25)
    assert_close(in_training.losses["simplification"], expected)
    assert in_test.losses == {}
