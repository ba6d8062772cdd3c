import pytest
import torch
from torch.nn import functional as F
from torch.testing import assert_close

from mops_lightning.nets import foldingnet
from mops_lightning.nets.foldingnet import REACH, Fold, FoldingDecoder, MFoldingNet, square_grid


@pytest.mark.parametrize("n", [1, 2, 7, 12, 79, 256, 313, 1024])
def test_square_grid_is_regular_and_nearly_square(n):
    grid = square_grid(n)

    assert grid.shape == (n, 2)
    assert grid.abs().max() <= REACH
    assert len(grid.unique(dim=0)) == n
    columns = len(grid[:, 0].unique())
    rows = len(grid[:, 1].unique())
    assert max(columns, rows) <= 4 * min(columns, rows)


def plain_folding(decoder, codeword, n):
    """FoldingNet's decoder as published, with the codeword repeated for every grid point."""
    clouds = len(codeword)
    repeated = codeword[:, None].expand(-1, n, -1)
    grid = square_grid(n).expand(clouds, -1, -1)
    once_folded = plain_fold(decoder.first, repeated, grid)
    return plain_fold(decoder.second, repeated, once_folded)


def plain_fold(fold, codewords, points):
    """One MLP on every codeword, joined with its point."""
    joined = torch.cat([codewords, points], 2)
    weights = [fold.from_piece.weight, fold.from_coordinates.weight]
    weight = torch.cat(weights, 1)
    hidden = F.linear(joined, weight, fold.from_piece.bias).relu()
    return fold.rest(fold.narrow(hidden))


def test_decoder_with_one_piece_equals_foldingnet(randn):
    decoder = FoldingDecoder(16, 1, (32, 8))
    codeword = randn(3, 16)

    folded = decoder(codeword, 48)

    expected = plain_folding(decoder, codeword, 48)
    assert_close(folded, expected, atol=1e-5, rtol=1e-4)


def test_decoder_pieces_share_weights(randn):
    decoder = FoldingDecoder(16, 4, (32, 8))
    of_one_piece = FoldingDecoder(4, 1, (32, 8))
    of_one_piece.load_state_dict(decoder.state_dict())
    codeword = randn(2, 16)

    out = decoder(codeword, 48).unflatten(1, (12, 4))

    for piece, part in enumerate(codeword.chunk(4, dim=1)):
        alone = of_one_piece(part, 12)
        assert_close(out[:, :, piece], alone, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(
    ("codeword", "published", "tolerance"),
    [
        (128, (4.7, 3.1, 2.9, 2.8, 2.8, 2.8, 2.8), 0.22),
        (512, (12, 5.4, 4.4, 3.9, 3.6, 3.5, 3.5), 0.45),
    ],
)
def test_mfoldingnet_has_published_size(codeword, published, tolerance):
    for pieces, size in zip((1, 4, 8, 16, 32, 64, 128), published, strict=True):
        net = MFoldingNet(10_000, pieces, codeword)
        sizes = [weights.numel() for weights in net.parameters()]
        megabytes = 4e-6 * sum(sizes)
        assert megabytes == pytest.approx(size, abs=tolerance)


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("rows", [4, 10, 1000])
@pytest.mark.parametrize("channels", [(12,), (12, 5), (12, 5, 4)])
def test_fold_in_blocks_equals_plain_folding(channels, rows, shared, randn, monkeypatch):
    monkeypatch.setitem(foldingnet.BLOCK_ROWS, "cpu", rows)
    torch.manual_seed(0)
    fold = Fold(6, 3, channels).double()
    number = 1 if shared else 5
    pieces = randn(5, 6, dtype=torch.float64).requires_grad_()
    coordinates = randn(number, 7, 3, dtype=torch.float64).requires_grad_()
    direction = randn(5, 7, 3, dtype=torch.float64)
    inputs = (pieces, coordinates, *fold.parameters())

    folded = fold(pieces, coordinates)

    of_pieces = fold.from_piece(pieces)[:, None]
    hidden = of_pieces + fold.from_coordinates(coordinates)
    expected = fold.rest(fold.narrow(hidden.relu()))
    gradients = torch.autograd.grad(folded, inputs, direction)
    expected_gradients = torch.autograd.grad(expected, inputs, direction)
    assert_close(folded, expected)
    assert_close(gradients, expected_gradients)


def test_fold_does_not_save_hidden_layer(randn):
    """For a cloud of 40,960 points, every hidden layer would take 335 MB."""
    fold = Fold(16, 3, (2048, 144))
    pieces = randn(4, 16, requires_grad=True)
    coordinates = randn(4, 500, 3)
    saved = []

    def save(tensor):
        saved.append(tensor.numel())
        return tensor

    def load(tensor):
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(save, load):
        fold(pieces, coordinates)

    size_of_hidden_layer = 4 * 500 * 2048
    assert max(saved) < size_of_hidden_layer // 8
