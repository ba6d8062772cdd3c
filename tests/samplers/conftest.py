import pytest
import torch

from mops_lightning.samplers.fmops import FMOPSNet
from mops_lightning.samplers.mops import MOPSNet


@pytest.fixture(params=[MOPSNet, FMOPSNet])
def trained(request, randn):
    """A sampler with running statistics from data and BatchNorm weights of both signs."""
    torch.manual_seed(5)
    made = request.param(24, feature_channels=(64, 48, 80), rho_channels=(96, 72, 40))
    made.train()
    for _ in range(3):
        made(randn(4, 100, 3) * 2 + 1)
    for name, value in made.named_parameters():
        if value.ndim == 1:
            torch.nn.init.normal_(value, 0.5 if name.endswith("bias") else 0.0)
    return made.eval()
