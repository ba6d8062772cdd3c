import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from mops_lightning.nets.pcrnet import PCRNet

SMALL = {"feature_channels": (16, 32)}


def net(**extra):
    torch.manual_seed(0)
    return PCRNet(**{**SMALL, **extra}).eval()


def test_pcrnet_has_published_layers():
    net = PCRNet()

    linear = [module for module in net.modules() if isinstance(module, torch.nn.Linear)]
    norms = [module for module in net.modules() if isinstance(module, torch.nn.BatchNorm1d)]

    shapes = [tuple(layer.weight.shape) for layer in linear]
    assert sorted(shapes) == [
        (7, 256),
        (64, 3),
        (64, 64),
        (64, 64),
        (128, 64),
        (256, 512),
        (512, 512),
        (512, 1024),
        (1024, 128),
        (1024, 1024),
        (1024, 2048),
    ]
    assert not norms


def test_pcrnet_untrained_leaves_clouds_without_extent_as_they_are():
    at_origin = torch.zeros(2, 9, 3)  # all features are 0, only the last bias is left

    motion = net()(at_origin, at_origin)

    assert motion.quaternion.tolist() == [[1, 0, 0, 0], [1, 0, 0, 0]]
    assert motion.translation.tolist() == [[0, 0, 0], [0, 0, 0]]


@pytest.mark.parametrize("iterations", [1, 3])
def test_pcrnet_is_independent_of_order_and_batch(iterations, rng, randn):
    module = net(iterations=iterations)
    source, target = randn(2, 4, 60, 3)
    order = torch.randperm(60, generator=rng)

    motion = module(source, target)
    in_order = module(source[:, order], target[:, order.flip(0)])
    alone = module(source[1:2], target[1:2])
    of_few_points = module(source[:, :20], target)

    assert_close(motion.quaternion.norm(dim=1), torch.ones(4))
    assert_close(in_order, motion, atol=1e-5, rtol=1e-5)
    second = motion.quaternion[1:2]
    assert_close(alone.quaternion, second, atol=1e-5, rtol=1e-5)
    assert of_few_points.translation.shape == (4, 3)


def homogeneous(motion):
    """The 4×4 matrices of motions, by SciPy."""
    quaternion = motion.quaternion.detach().numpy()
    scalar_last = np.roll(quaternion, -1, 1)
    matrices = np.tile(np.eye(4), (len(quaternion), 1, 1))
    matrices[:, :3, :3] = Rotation.from_quat(scalar_last).as_matrix()
    matrices[:, :3, 3] = motion.translation.detach().numpy()
    return matrices


def test_pcrnet_pose_is_product_of_homogeneous_matrices(randn):
    source, target = randn(2, 4, 60, 3)
    one = net()
    three = net(iterations=3)

    motion = three(source, target)

    total = np.tile(np.eye(4), (4, 1, 1))
    moved = source
    for _ in range(3):
        step = homogeneous(one(moved, target))
        assert np.abs(step - np.eye(4)).max() > 0.1
        total = step @ total
        rotation = total[:, :3, :3]
        translation = total[:, None, :3, 3]
        rotated = source.numpy() @ rotation.swapaxes(1, 2)
        moved = torch.from_numpy(rotated + translation).float()
    np.testing.assert_allclose(homogeneous(motion), total, atol=1e-5)


def spread(module, rng):
    """Return the deviation of the last hidden layer between pairs, relative to its mean."""
    source, target = torch.randn(2, 16, 100, 3, generator=rng)
    of_source = module.pool(module.features(source))
    of_target = module.pool(module.features(target))
    hidden = module.head(torch.cat([of_source, of_target], 1))
    deviation = hidden.std(0).mean()
    return (deviation / hidden.abs().mean()).item()


def test_pcrnet_initial_weights_keep_the_signal(rng):
    module = PCRNet().eval()
    ours = spread(module, rng)

    for layer in module.modules():
        if isinstance(layer, torch.nn.Linear):
            layer.reset_parameters()
    of_default_weights = spread(module, rng)

    assert ours > 20 * of_default_weights
