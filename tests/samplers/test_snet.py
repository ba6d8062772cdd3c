import pytest
import torch
from torch import nn

from mops_lightning.errors import UserError
from mops_lightning.losses import subset as losses
from mops_lightning.losses.subset import simplification_loss
from mops_lightning.samplers.snet import ProgressiveSNet, SNet


def double_loop(points, samples, coverage, per_point):
    """The publication's loss word for word, one number at a time."""
    total = 0.0
    for cloud, sample in zip(points, samples, strict=True):
        there = [min(float((q - p).square().sum()) for p in cloud) for q in sample]
        back = [min(float((q - p).square().sum()) for q in sample) for p in cloud]
        mean = sum(there) / len(there)
        total += mean + max(there) + (coverage + per_point * len(there)) * sum(back) / len(back)
    return total / len(points)


@pytest.mark.parametrize(("coverage", "per_point"), [(1.0, 0.0), (0.5, 1 / 30), (0.0, 1 / 64)])
def test_simplification_loss_equals_a_double_loop(coverage, per_point, rng):
    points = torch.randn(3, 17, 3, generator=rng)
    samples = torch.randn(3, 5, 3, generator=rng)
    value = float(simplification_loss(points, samples, coverage, per_point))
    assert value == pytest.approx(double_loop(points, samples, coverage, per_point), rel=1e-5)


def test_simplification_loss_has_right_gradients(rng):
    points = torch.randn(2, 9, 3, generator=rng, dtype=torch.float64)
    samples = torch.randn(2, 4, 3, generator=rng, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda q: simplification_loss(points, q, 0.5, 0.1), (samples,))
    assert simplification_loss(points, points) == 0


@pytest.mark.parametrize("name", ["subset", "simplification"])
def test_losses_of_many_sizes_are_those_of_each(name, rng):
    points = torch.randn(3, 30, 3, generator=rng, dtype=torch.float64)
    samples = torch.randn(3, 12, 3, generator=rng, dtype=torch.float64, requires_grad=True)
    extra = (0.5, 0.1) if name == "simplification" else ()
    many, one = getattr(losses, f"{name}_losses"), getattr(losses, f"{name}_loss")
    sizes = (12, 1, 5)
    together = many(points, samples, sizes, *extra)
    assert set(together) == set(sizes)
    for m in sizes:
        alone = one(points, samples[:, :m].clone(), *extra)
        torch.testing.assert_close(together[m], alone)
        (got,) = torch.autograd.grad(together[m], samples, retain_graph=True)
        (want,) = torch.autograd.grad(alone, samples)
        torch.testing.assert_close(got, want)


def layers(net):
    return [tuple(m.weight.shape) for m in net.modules() if isinstance(m, nn.Linear)]


def test_published_layers_for_classification():
    net = SNet(32)
    assert layers(net) == [
        (64, 3), (64, 64), (64, 64), (128, 64), (128, 128),
        (256, 128), (256, 256), (256, 256), (96, 256),
    ]  # fmt: skip
    assert sum(isinstance(m, nn.BatchNorm1d) for m in net.modules()) == 9


def test_published_layers_for_reconstruction():
    net = SNet(
        32,
        feature_channels=(64, 128, 128, 256, 128),
        head_channels=(256, 256),
        head_norm=False,
        output_norm=False,
    )
    assert layers(net) == [
        (64, 3), (128, 64), (128, 128), (256, 128), (128, 256), (256, 128), (256, 256), (96, 256),
    ]  # fmt: skip
    assert sum(isinstance(m, nn.BatchNorm1d) for m in net.modules()) == 5


def test_its_loss_is_weighted_and_there_in_training_only(rng):
    net = SNet(6, alpha=3.0, coverage=0.5, coverage_per_point=0.25).train()
    points = torch.randn(4, 20, 3, generator=rng)
    output = net(points)
    expected = 3 * simplification_loss(points, output.points, 0.5, 0.25)
    torch.testing.assert_close(output.losses["simplification"], expected)
    assert net.eval()(points).losses == {}


def test_progressive_sizes_are_the_powers_of_two():
    assert ProgressiveSNet().training_sizes() == (2, 4, 8, 16, 32, 64, 128, 256, 512, 1024)
    assert ProgressiveSNet(100, min_size=16).training_sizes() == (16, 32, 64, 100)
    assert ProgressiveSNet(1).training_sizes() == (1,)


def test_progressive_samples_are_nested_each_with_the_loss_of_its_size(rng):
    net = ProgressiveSNet(16, coverage=0.5, coverage_per_point=1 / 30).train()
    points = torch.randn(4, 40, 3, generator=rng)
    net(points)  # running statistics move with every call, the result does not
    whole = net(points).points
    outputs = net.sample_sizes(points, net.training_sizes())
    assert list(outputs) == [2, 4, 8, 16]
    for m, output in outputs.items():
        assert torch.equal(output.points, whole[:, :m])
        expected = 30 * simplification_loss(points, whole[:, :m], 0.5, 1 / 30)
        torch.testing.assert_close(output.losses["simplification"], expected)


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"alpha": -1.0}, "sampler.alpha must not be negative, got -1.0"),
        ({"coverage": -1.0}, "sampler.coverage must not"),
        ({"feature_channels": (8,)}, "feature_channels must be sizes of at least 2 layers"),
        ({"head_channels": (0,)}, "head_channels must be .* each at least 1, got .0."),
        ({"least": 0}, "sampler.least must be at least 1, got 0"),
        ({"size_reduction": "summ"}, "sampler.size_reduction: unknown 'summ'.*sum"),
    ],
)
def test_wrong_settings_are_refused(settings, named):
    with pytest.raises(UserError, match=named):
        ProgressiveSNet(8, **settings)
