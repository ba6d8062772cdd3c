"""Mixed precision: half precision in the pointwise layers, float32 everywhere else."""

import pytest
import torch
from torch.nn import functional as F
from torch.testing import assert_close

from mops_lightning.nets.foldingnet import MFoldingNet
from mops_lightning.nets.max_pool import PLAIN_MAX_POINTS, PointMaxPool
from mops_lightning.nets.pcrnet import PCRNet
from mops_lightning.ops.precision import (
    full_precision,
    pointwise_autocast_dtype,
    restrict_autocast_to_pointwise,
)
from mops_lightning.ops.rigid import Motion
from mops_lightning.samplers.mops import MOPSNet
from tests.support.mixed import mixed


def seen_dtypes(module, call):
    """Return the output dtypes of linear layers by name."""
    seen = {}
    hooks = [
        layer.register_forward_hook(lambda _, __, out, name=name: seen.update({name: out.dtype}))
        for name, layer in module.named_modules()
        if isinstance(layer, torch.nn.Linear)
    ]
    call()
    for hook in hooks:
        hook.remove()
    return seen


def test_mops_net_first_layer_is_float32(randn):
    points = randn(2, 50, 3)
    net = MOPSNet(8)
    seen = seen_dtypes(net, lambda: mixed(net, points))
    assert seen.pop("features.mlp.layers.0") == torch.float32
    assert set(seen.values()) == {torch.bfloat16}


def test_full_precision_disables_autocast(randn):
    points = randn(2, 50, 3)
    net = MOPSNet(8).eval()
    with torch.no_grad():
        expected = net(points).points
        with torch.autocast("cpu", torch.bfloat16), full_precision("cpu"):
            assert torch.equal(net(points).points, expected)


@pytest.mark.parametrize("training", [True, False])
def test_mops_net_sampling_matrix_is_float32(training, randn):
    points = F.normalize(randn(4, 200, 3), dim=2)
    net = MOPSNet(16).train(training)
    in_single = net(points).points

    output = mixed(net, points)

    dense = output.matrix.dense()
    assert output.points.dtype == torch.float32
    assert output.matrix.keys.dtype == torch.float32
    assert dense.dtype == torch.float32
    assert_close(dense.sum(1), torch.ones(4, 16))
    assert_close(dense.mT @ points, output.points)
    error = (output.points - in_single).abs().max()
    assert 0 < error < 0.02


def pooled_with_gradients(pool, features, direction):
    """Return maxima in mixed precision, and the gradients of features and weights."""
    leaf = features.clone().requires_grad_()
    pooled = mixed(pool, leaf)
    loss = (pooled * direction).sum()
    of_features, of_weights = torch.autograd.grad(loss, (leaf, pool.linear.weight))
    assert pooled.dtype == torch.float32
    assert of_features.dtype == features.dtype
    assert of_weights.dtype == torch.float32
    return pooled.detach(), of_features.float(), of_weights


@pytest.mark.parametrize("n", [PLAIN_MAX_POINTS, 100])
@pytest.mark.parametrize("norm", [True, False])
def test_max_pool_half_precision_is_close_with_its_gradients(n, norm, rng, randn):
    # Small whole numbers: their products are exact in half precision, so the same points win.
    features = torch.randint(-2, 3, (3, n, 16), generator=rng).float()
    pool = PointMaxPool(16, 64, norm)
    pool.linear.weight.data = torch.randint(-3, 4, (64, 16), generator=rng).float()
    direction = randn(3, 64)

    in_single = pooled_with_gradients(pool, features, direction)
    in_half = pooled_with_gradients(pool, features.bfloat16(), direction)

    assert_close(in_half, in_single, rtol=0.02, atol=0.02)


def output_and_gradients(net, arguments):
    """Return what a net gives, and the gradients of its weights, in float32."""
    output = net(*arguments)
    if isinstance(output, Motion):
        output = output.quaternion
    output = output.float()
    net.zero_grad()
    output[..., 1].sum().backward()
    gradients = [p.grad.flatten() for p in net.parameters() if p.grad is not None]
    return output.detach(), torch.cat(gradients)


@pytest.mark.parametrize(
    "make",
    [PCRNet, lambda: MFoldingNet(64, 4, 64), lambda: MFoldingNet(64, 1, 64)],
    ids=["pcrnet", "mfoldingnet", "foldingnet"],
)
def test_nets_under_plain_autocast_are_close(make, randn):
    net = make()
    points = randn(4, 60, 3)
    arguments = (points, points + 0.1) if isinstance(net, PCRNet) else (points,)
    expected, expected_gradients = output_and_gradients(net, arguments)

    with torch.autocast("cpu", torch.bfloat16):
        output, gradients = output_and_gradients(net, arguments)

    assert_close(output, expected, rtol=0.05, atol=0.05)
    assert F.cosine_similarity(gradients, expected_gradients, dim=0) > 0.9


def test_pointwise_layers_keep_the_dtype_of_the_training_as_long_as_the_step_lasts():
    dtypes = []
    with torch.autocast("cpu", torch.bfloat16), restrict_autocast_to_pointwise("cpu"):
        dtypes.append(pointwise_autocast_dtype())
        with restrict_autocast_to_pointwise("cpu"):
            dtypes.append(pointwise_autocast_dtype())
        dtypes.append(pointwise_autocast_dtype())
    dtypes.append(pointwise_autocast_dtype())

    assert dtypes == [torch.bfloat16, torch.bfloat16, torch.bfloat16, None]
