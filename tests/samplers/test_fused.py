"""MOPS-Net with fused BatchNorm against the plain layers."""

import pytest
import torch


@pytest.mark.parametrize(("clouds", "points"), [(3, 40), (2, 2500), (1, 24)])
def test_fused_evaluation_equals_layers(trained, clouds, points, rng):
    batch = torch.randn(clouds, points, 3, generator=rng)
    plain = trained(batch)
    with torch.no_grad():
        fast = trained(batch)
    assert plain.points.requires_grad
    assert not fast.points.requires_grad
    torch.testing.assert_close(fast.points, plain.points.detach(), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(fast.matrix.dense(), plain.matrix.dense(), rtol=1e-3, atol=1e-6)


def test_training_without_gradients_uses_batch_statistics(trained, rng):
    batch = torch.randn(3, 40, 3, generator=rng)
    trained.train()
    with torch.no_grad():
        fast = trained(batch).points
    torch.testing.assert_close(fast, trained(batch).points.detach())
