import pytest
import torch

from mops_lightning.nets import folding


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("rows", [4, 10, 1000])
@pytest.mark.parametrize("channels", [(12,), (12, 5), (12, 5, 4)])
def test_fold_in_blocks_equals_plain_folding(channels, rows, shared, rng, monkeypatch):
    monkeypatch.setitem(folding.BLOCK_ROWS, "cpu", rows)
    torch.manual_seed(0)
    fold = folding.Fold(6, 3, channels).double()
    pieces = torch.randn(5, 6, generator=rng, dtype=torch.float64).requires_grad_()
    coordinates = torch.randn(1 if shared else 5, 7, 3, generator=rng, dtype=torch.float64)
    coordinates.requires_grad_()

    def plain():
        hidden = fold.from_piece(pieces)[:, None] + fold.from_coordinates(coordinates)
        return fold.rest(fold.narrow(hidden.relu()))

    inputs = (pieces, coordinates, *fold.parameters())
    torch.testing.assert_close(fold(pieces, coordinates), plain())
    weights = torch.randn(5, 7, 3, generator=rng, dtype=torch.float64)
    want = torch.autograd.grad((plain() * weights).sum(), inputs)
    torch.testing.assert_close(
        torch.autograd.grad((fold(pieces, coordinates) * weights).sum(), inputs), want
    )


def test_fold_does_not_save_hidden_layer(rng):
    """For a cloud of 40,960 points, every hidden layer would take 335 MB."""
    fold = folding.Fold(16, 3, (2048, 144))
    pieces = torch.randn(4, 16, generator=rng, requires_grad=True)
    saved = []

    def save(tensor):
        saved.append(tensor.numel())
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(save, lambda tensor: tensor):
        fold(pieces, torch.randn(4, 500, 3, generator=rng))
    assert max(saved) < 2000 * 2048 // 8
