import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.nets.atlasnet import AtlasNet


def test_atlasnet_is_random_in_training_only(rng):
    torch.manual_seed(0)
    net = AtlasNet(50, 3, 16, (32, 8))
    points = torch.randn(2, 40, 3, generator=rng)
    assert not torch.equal(net(points), net(points))
    net.eval()
    assert torch.equal(net(points), net(points))
    assert len({id(parameter) for parameter in net.patches.parameters()}) == 3 * 10


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"pieces": 0}, r"^pieces must be at least 1, got 0"),
        ({"pieces": 4, "n_points": 3}, r"^n_points must be at least pieces=4, got 3"),
        ({"patch_channels": [0]}, r"^patch_channels must be .*got \[0\]"),
    ],
)
def test_atlasnet_invalid_argument_raises(arguments, message):
    with pytest.raises(UserError, match=message):
        AtlasNet(**arguments)
