import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.nets.layers import (
    LIMIT,
    PointFeatures,
    check_channels,
    fit_attribute_scales,
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


def test_attribute_scale_standardises_within_limits(rng):
    points = torch.randn(4, 50, 6, generator=rng) * 100 + 500
    points[..., 4] = 7.0
    points[0, 0, 5] = 1e6
    net = PointFeatures((8, 6), attributes=3)
    fit_attribute_scales(net, points)
    scaled = net.scale(points)
    assert torch.equal(scaled[..., :3], points[..., :3])
    values = scaled[..., 3]
    assert values.mean().item() == pytest.approx(0, abs=1e-4)
    assert values.std(correction=0).item() == pytest.approx(1, rel=1e-4)
    assert (scaled[..., 4] == 0).all()
    assert scaled[0, 0, 5] == LIMIT
    assert net.scale(2 * points - 1e5)[..., 3].min() == -LIMIT


def test_point_features_without_attributes_has_no_further_state():
    assert all(name.startswith("mlp.") for name in PointFeatures((8, 6)).state_dict())
