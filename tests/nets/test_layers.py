import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.nets.layers import (
    PointFeatures,
    check_channels,
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
