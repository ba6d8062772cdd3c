"""AtlasNet's squares."""

import pytest
import torch

from mops_lightning.nets.atlasnet import AtlasNet
from mops_lightning.nets.foldingnet import REACH


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
