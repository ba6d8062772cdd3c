import copy

import pytest
import torch
from torch import nn

from mops_lightning.errors import UserError
from mops_lightning.nets.layers import (
    PointFeatures,
    PointMLP,
    check_channels,
    copy_pointwise_layers,
)


def test_point_features_global_is_maximum_of_local(rng):
    torch.manual_seed(0)
    net = PointFeatures((8, 6)).eval()
    points = torch.randn(2, 30, 3, generator=rng)
    local, global_ = net(points)
    assert local.shape == (2, 30, 6)
    torch.testing.assert_close(global_, local.max(1).values)


@pytest.mark.parametrize(
    ("channels", "min_layers", "message"),
    [
        ((), 1, r"widths must be sizes of at least 1 layer, .* got \[\]"),
        ((8,), 2, r"widths must be sizes of at least 2 layers, .* got \[8\]"),
        ((8, 0), 1, r"each at least 1, got \[8, 0\]"),
    ],
)
def test_check_channels_invalid_raises(channels, min_layers, message):
    with pytest.raises(UserError, match=message):
        check_channels("widths", channels, min_layers)


def test_copy_pointwise_layers_copies_until_shapes_differ():
    torch.manual_seed(0)
    source, target = PointMLP([3, 8, 8, 16, 32]), PointFeatures([8, 8, 16, 16])
    source(torch.randn(2, 9, 3))  # moves the running statistics
    before = copy.deepcopy(target.state_dict())
    assert copy_pointwise_layers(nn.Sequential(nn.Linear(3, 3), source), target) == 3
    theirs, mine = source.layers.state_dict(), target.mlp.layers.state_dict()
    for name, value in mine.items():
        same = int(name.split(".")[0]) < 9  # three times linear layer, BatchNorm and ReLU
        expected = theirs[name] if same else before[f"mlp.layers.{name}"]
        assert torch.equal(value, expected), name
    with torch.no_grad():
        next(source.parameters()).zero_()
    assert next(target.parameters()).any()  # a copy, not the same tensor


def test_copy_pointwise_layers_without_norm_or_stack_copies_none():
    assert copy_pointwise_layers(PointMLP([3, 8], norm=False), PointMLP([3, 8])) == 0
    assert copy_pointwise_layers(nn.Linear(3, 8), PointMLP([3, 8])) == 0
