import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.nets.pcrnet import PCRNet

SMALL = {"feature_channels": (16, 32), "head_channels": (32, 16)}


def net(**extra):
    torch.manual_seed(0)
    return PCRNet(**{**SMALL, **extra}).eval()


def test_published_layers():
    shapes = [tuple(m.weight.shape) for m in PCRNet().modules() if isinstance(m, torch.nn.Linear)]
    points = [(64, 3), (64, 64), (64, 64), (128, 64), (1024, 128)]
    head = [(1024, 2048), (1024, 1024), (512, 1024), (512, 512), (256, 512), (7, 256)]
    assert sorted(shapes) == sorted(points + head)
    assert not any(isinstance(m, torch.nn.BatchNorm1d) for m in PCRNet().modules())


@pytest.mark.parametrize("iterations", [1, 3])
def test_answers_are_motions_that_mind_neither_order_nor_batch_nor_number(iterations, rng):
    module = net(iterations=iterations)
    source, target = torch.randn(2, 4, 60, 3, generator=rng)
    answer = module(source, target)
    torch.testing.assert_close(answer.quaternion.norm(dim=1), torch.ones(4))
    order = torch.randperm(60, generator=rng)
    shuffled = module(source[:, order], target[:, order.flip(0)])
    torch.testing.assert_close(shuffled, answer, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(
        module(source[1:2], target[1:2]).quaternion, answer.quaternion[1:2], atol=1e-5, rtol=1e-5
    )
    assert module(source[:, :20], target).translation.shape == (4, 3)


def test_iterations_move_the_source_and_add_up(rng):
    source, target = torch.randn(2, 4, 60, 3, generator=rng)
    one, three = net(), net(iterations=3)
    three.load_state_dict(one.state_dict())
    total = one(source, target)
    for _ in range(2):
        total = one(total.apply(source), target).after(total)
    torch.testing.assert_close(three(source, target), total, atol=1e-5, rtol=1e-5)


def spread(module, rng):
    """How much the last hidden layer tells different pairs apart, against its own size."""
    source, target = torch.randn(2, 16, 100, 3, generator=rng)
    both = [module.pool(module.features(cloud)) for cloud in (source, target)]
    hidden = module.head(torch.cat(both, 1))
    return (hidden.std(0).mean() / hidden.abs().mean()).item()


def test_the_signal_reaches_the_last_layer_as_it_would_not_from_the_usual_weights(rng):
    torch.manual_seed(0)
    module = PCRNet().eval()
    ours = spread(module, rng)
    for layer in module.modules():
        if isinstance(layer, torch.nn.Linear):
            layer.reset_parameters()
    assert ours > 20 * spread(module, rng)


def test_settings_out_of_range_are_refused():
    with pytest.raises(UserError, match=r"task.net.iterations must be at least 1, got 0"):
        PCRNet(0)
    with pytest.raises(UserError, match=r"task.net.feature_channels must be .* got \[8\]"):
        PCRNet(feature_channels=[8])
    with pytest.raises(UserError, match=r"task.net.head_channels must be .* got \[\]"):
        PCRNet(head_channels=[])
