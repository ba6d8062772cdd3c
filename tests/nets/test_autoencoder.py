import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.nets.autoencoder import AutoEncoder, PointEncoder


def test_encoder_has_published_layers():
    layers = [m for m in PointEncoder().modules() if isinstance(m, torch.nn.Linear)]
    sizes = [tuple(layer.weight.shape) for layer in layers]
    assert sizes == [(64, 3), (128, 64), (128, 128), (256, 128), (128, 256)]


def test_autoencoder_other_number_of_points_raises(rng):
    net = AutoEncoder(50, 16, (8, 8))
    with pytest.raises(UserError, match=r"^n_points must be 50, .* got 60.*mfoldingnet"):
        net(torch.randn(2, 40, 3, generator=rng), 60)


def test_autoencoder_has_published_size():
    megabytes = 4e-6 * sum(p.numel() for p in AutoEncoder().parameters())
    assert megabytes == pytest.approx(4.1, abs=0.2)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: AutoEncoder(0), r"^n_points must be at least 1, got 0"),
        (lambda: AutoEncoder(codeword=0), r"^codeword must be at least 1, got 0"),
        (lambda: AutoEncoder(encoder_channels=[]), r"^encoder_channels must be .*got \[\]"),
        (lambda: PointEncoder(0), r"^codeword must be at least 1, got 0"),
        (lambda: PointEncoder(channels=[0]), r"^channels must be .*got \[0\]"),
    ],
)
def test_autoencoder_invalid_argument_raises(make, message):
    with pytest.raises(UserError, match=message):
        make()
