"""Mixed precision as a training step sets it."""

import torch

from mops_lightning.ops.precision import restrict_autocast_to_pointwise


def mixed(function, *arguments):
    with torch.autocast("cpu", torch.bfloat16), restrict_autocast_to_pointwise("cpu"):
        return function(*arguments)


def check_close_in_mixed_precision(net, points):
    """Compare a net's output with that in float32, and require finite gradients of it."""
    single, half = net(points), mixed(net, points)
    assert half.dtype == torch.float32
    torch.testing.assert_close(half, single, rtol=0.05, atol=0.05)
    half.square().sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in net.parameters())
