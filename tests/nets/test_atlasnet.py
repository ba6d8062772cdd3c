"""AtlasNet's squares."""

import pytest
import torch

from mops_lightning.nets.atlasnet import AtlasNet
from mops_lightning.nets.foldingnet import REACH, square_grid


@pytest.mark.parametrize("is_training", [True, False])
def test_patches_map_the_same_square_in_training_and_in_evaluation(is_training):
    torch.manual_seed(0)
    net = AtlasNet(800, pieces=2, codeword=8, patch_channels=(16,)).train(is_training)
    squares = []
    for patch in net.patches:
        patch.register_forward_pre_hook(lambda _, inputs: squares.append(inputs[1]))

    net.from_pooled(torch.randn(3, 8))

    assert len(squares) == 2
    for square in squares:
        lowest = square.amin((0, 1))
        highest = square.amax((0, 1))
        assert lowest.tolist() == pytest.approx([-REACH, -REACH], abs=0.01)
        assert highest.tolist() == pytest.approx([REACH, REACH], abs=0.01)


def test_patches_of_every_cloud_have_random_points_of_their_own_in_training():
    net = AtlasNet(80, pieces=2, codeword=8, patch_channels=(16,)).train()
    squares = []
    for patch in net.patches:
        patch.register_forward_pre_hook(lambda _, inputs: squares.append(inputs[1]))

    net.from_pooled(torch.randn(2, 8))

    of_first_patch, of_second_patch = squares
    first_cloud, second_cloud = of_first_patch
    assert not torch.equal(first_cloud, second_cloud)
    assert not torch.equal(of_first_patch, of_second_patch)


def test_surplus_points_are_dropped_from_the_last_patches():
    net = AtlasNet(8, pieces=3, codeword=8, patch_channels=(16,)).eval()
    codeword = torch.randn(1, 8)

    (of_eight,) = net.from_pooled(codeword)
    (of_nine,) = net.from_pooled(codeword, 9)

    assert torch.equal(of_eight, of_nine[:8])
    square = square_grid(3)[None]
    last_of_each = [patch(codeword, square)[0, 2] for patch in net.patches]
    assert torch.allclose(of_nine[6:], torch.stack(last_of_each), atol=1e-6)
