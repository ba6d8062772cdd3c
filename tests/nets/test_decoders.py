"""The nets that reconstruct clouds: auto-encoder, FoldingNet, M-FoldingNet, AtlasNet."""

import pytest
import torch
from torch.nn import functional as F

from mops_lightning.errors import UserError
from mops_lightning.nets import folding
from mops_lightning.nets.atlasnet import AtlasNet
from mops_lightning.nets.autoencoder import AutoEncoder, PointEncoder
from mops_lightning.nets.foldingnet import (
    REACH,
    FoldingDecoder,
    GraphEncoder,
    MFoldingNet,
    square_grid,
)

SMALL = {
    "autoencoder": lambda n: AutoEncoder(n, 16, (8, 8), (16,)),
    "foldingnet": lambda n: MFoldingNet(n, 1, 16, fold_channels=(32, 8)),
    "mfoldingnet": lambda n: MFoldingNet(n, 4, 16, fold_channels=(32, 8)),
    "graph": lambda n: MFoldingNet(n, 4, 16, "graph", fold_channels=(32, 8)),
    "atlasnet": lambda n: AtlasNet(n, 3, 16, (32, 8)),
}


def megabytes(module):
    return 4e-6 * sum(p.numel() for p in module.parameters())


@pytest.mark.parametrize("name", SMALL)
def test_every_net_emits_its_points_whatever_comes_in_what_order_and_batch(name, rng):
    torch.manual_seed(0)
    net = SMALL[name](50).eval()
    points = torch.randn(3, 40, 3, generator=rng)
    out = net(points)
    assert out.shape == (3, 50, 3)
    order = torch.randperm(40, generator=rng)
    torch.testing.assert_close(net(points[:, order]), out, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(net(points[1:2]), out[1:2], atol=1e-5, rtol=1e-4)
    assert net(points[:, :7]).shape == (3, 50, 3)


@pytest.mark.parametrize("name", SMALL)
def test_every_parameter_gets_a_gradient(name, rng):
    torch.manual_seed(0)
    net = SMALL[name](50)
    net(torch.randn(3, 40, 3, generator=rng)).square().sum().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in net.parameters())


@pytest.mark.parametrize("name", ["foldingnet", "mfoldingnet", "graph", "atlasnet"])
@pytest.mark.parametrize("n", [4, 7, 50, 101, 300])
def test_the_number_of_points_follows_the_grid_and_can_change(name, n, rng):
    torch.manual_seed(0)
    net = SMALL[name](50).eval()
    points = torch.randn(2, 40, 3, generator=rng)
    assert net(points, n).shape == (2, n, 3)
    net.n_points = n
    torch.testing.assert_close(net(points), net(points, n))


def test_the_auto_encoder_cannot_change_its_number(rng):
    net = SMALL["autoencoder"](50)
    with pytest.raises(UserError, match=r"emits the 50 points .*not 60.*mfoldingnet"):
        net(torch.randn(2, 40, 3, generator=rng), 60)


def plain_folding(decoder, codeword, n):
    """FoldingNet's decoder as published: the codeword repeated beside every grid point."""
    grid = square_grid(n).expand(len(codeword), -1, -1)
    points = grid
    for fold in (decoder.first, decoder.second):
        rows = torch.cat([codeword[:, None].expand(-1, n, -1), points], 2)
        weight = torch.cat([fold.from_piece.weight, fold.from_coordinates.weight], 1)
        hidden = F.relu(F.linear(rows, weight, fold.from_piece.bias))
        points = fold.rest(fold.narrow(hidden))
    return points


def test_one_piece_is_the_decoder_of_foldingnet(rng):
    torch.manual_seed(0)
    decoder = FoldingDecoder(16, 1, (32, 8))
    codeword = torch.randn(3, 16, generator=rng)
    torch.testing.assert_close(
        decoder(codeword, 48), plain_folding(decoder, codeword, 48), atol=1e-5, rtol=1e-4
    )


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("rows", [4, 10, 1000])
@pytest.mark.parametrize("channels", [(12,), (12, 5), (12, 5, 4)])
def test_folding_by_blocks_is_the_plain_folding(channels, rows, shared, rng, monkeypatch):
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


def test_folding_does_not_hold_its_widest_layer(rng):
    """One cloud of 40,960 points has 335 MB in each."""
    fold = folding.Fold(16, 3, (2048, 144))
    pieces = torch.randn(4, 16, generator=rng, requires_grad=True)
    kept = []

    def keep(tensor):
        kept.append(tensor.numel())
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        fold(pieces, torch.randn(4, 500, 3, generator=rng))
    assert max(kept) < 2000 * 2048 // 8


def test_every_piece_is_folded_by_the_same_operator(rng):
    torch.manual_seed(0)
    decoder = FoldingDecoder(16, 4, (32, 8))
    codeword = torch.randn(2, 16, generator=rng)
    out = decoder(codeword, 48).unflatten(1, (12, 4))
    one = FoldingDecoder(4, 1, (32, 8))
    one.load_state_dict(decoder.state_dict())
    for piece in range(4):
        alone = one(codeword[:, 4 * piece : 4 * piece + 4], 12)
        torch.testing.assert_close(out[:, :, piece], alone, atol=1e-5, rtol=1e-4)


def test_pieces_cost_nothing_but_a_shorter_slice_of_the_codeword():
    width = 2048
    whole = sum(p.numel() for p in MFoldingNet(pieces=1).parameters())
    for pieces in (4, 8, 16, 32, 64, 128):
        cut = sum(p.numel() for p in MFoldingNet(pieces=pieces).parameters())
        assert whole - cut == 2 * width * (128 - 128 // pieces)


@pytest.mark.parametrize(
    ("codeword", "published", "tolerance"),
    [
        (128, (4.7, 3.1, 2.9, 2.8, 2.8, 2.8, 2.8), 0.22),
        (512, (12, 5.4, 4.4, 3.9, 3.6, 3.5, 3.5), 0.45),
    ],
)
def test_model_sizes_are_near_the_published_ones(codeword, published, tolerance):
    for pieces, size in zip((1, 4, 8, 16, 32, 64, 128), published, strict=True):
        net = MFoldingNet(10_000, pieces, codeword)
        assert megabytes(net) == pytest.approx(size, abs=tolerance)
    assert megabytes(AutoEncoder()) == pytest.approx(4.1, abs=0.2)


def test_the_encoder_is_the_one_of_the_paper():
    layers = [m for m in PointEncoder().modules() if isinstance(m, torch.nn.Linear)]
    sizes = [tuple(layer.weight.shape) for layer in layers]
    assert sizes == [(64, 3), (128, 64), (128, 128), (256, 128), (128, 256)]


def test_grids_are_regular_near_square_and_of_any_number():
    for n in (1, 2, 7, 12, 79, 256, 313, 1024):
        grid = square_grid(n)
        assert grid.shape == (n, 2)
        assert grid.abs().max() <= REACH
        assert len({tuple(row) for row in grid.tolist()}) == n
        sides = sorted(len(set(grid[:, axis].tolist())) for axis in (0, 1))
        assert sides[1] <= 4 * sides[0]


def test_graph_encoder_looks_at_neighbours(rng):
    torch.manual_seed(0)
    net = GraphEncoder(16, k=4).eval()
    points = torch.randn(2, 30, 3, generator=rng)
    assert net(points).shape == (2, 16)
    assert net(points[:, :2]).shape == (2, 16)  # fewer points than k


def test_atlasnet_draws_in_training_and_not_in_test(rng):
    torch.manual_seed(0)
    net = AtlasNet(50, 3, 16, (32, 8))
    points = torch.randn(2, 40, 3, generator=rng)
    assert not torch.equal(net(points), net(points))
    net.eval()
    assert torch.equal(net(points), net(points))
    assert len({id(parameter) for parameter in net.patches.parameters()}) == 3 * 10


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: MFoldingNet(pieces=3), r"task.net.pieces must divide the codeword's 128 .*got 3"),
        (lambda: MFoldingNet(n_points=2), r"task.net.n_points must be at least .*pieces=4, got 2"),
        (lambda: MFoldingNet(fold_channels=[]), r"task.net.fold_channels must be .*got \[\]"),
        (lambda: MFoldingNet()(torch.randn(2, 9, 3), 3), r"at least task.net.pieces=4, got 3"),
        (lambda: AtlasNet(pieces=0), r"task.net.pieces must be at least 1"),
        (lambda: AtlasNet(patch_channels=[0]), r"task.net.patch_channels must be .*got \[0\]"),
        (lambda: AutoEncoder(0), r"task.net.n_points must be at least 1, got 0"),
        (lambda: AutoEncoder(decoder_channels=[]), r"task.net.decoder_channels must be"),
        (lambda: PointEncoder(0), "at least 1, got 0"),
        (lambda: GraphEncoder(8, 0), "at least 1, got 8 and 0"),
    ],
)
def test_numbers_out_of_range_are_named(make, said):
    with pytest.raises(UserError, match=said):
        make()
