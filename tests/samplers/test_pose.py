import numpy as np
import pytest
import torch
from torch.testing import assert_close

from mops_lightning import PoseSampler
from mops_lightning.errors import UserError
from mops_lightning.ops.neighbourhoods import FEATURES, describe_neighbourhoods
from mops_lightning.ops.stability import plane_rows, steady_places
from mops_lightning.samplers.ordering import seeded_order
from tests.ops.test_stability import box


@pytest.fixture
def sampler():
    torch.manual_seed(0)
    return PoseSampler(64, feature_channels=(8, 6), head_channels=(5,)).double().eval()


@pytest.fixture
def cloud():
    return torch.from_numpy(box(200))[None]


@pytest.mark.parametrize("seed", [0, 3])
def test_sample_equals_choice_by_predicted_residuals(sampler, cloud, seed):
    sampler.seed = seed

    output = sampler(cloud, 20)

    order = seeded_order(cloud, seed)[0].numpy()
    points = cloud[0].numpy()[order]
    described = describe_neighbourhoods(points)
    spread = np.exp(output.log_residuals[0].detach().numpy())[order]
    places = steady_places(plane_rows(points, described.normals), spread, 20)
    assert output.indices[0].tolist() == order[places].tolist()


def test_log_residuals_are_in_the_order_of_the_points(sampler, cloud):
    order = torch.randperm(200, generator=torch.Generator().manual_seed(1))

    residuals = sampler(cloud).log_residuals
    residuals_in_order = sampler(cloud[:, order]).log_residuals

    assert_close(residuals_in_order, residuals[:, order])


def test_log_residuals_follow_from_features_and_their_mean_and_maximum(sampler, randn):
    features = randn(2, 30, FEATURES, dtype=torch.float64)

    found = sampler.log_residuals(features)

    local = sampler.features(features)
    mean = local.mean(1, keepdim=True).expand_as(local)
    largest = local.amax(1, keepdim=True).expand_as(local)
    inputs = torch.cat([local, mean, largest], 2).flatten(0, 1)
    expected = sampler.last(sampler.head(inputs))
    assert_close(found, expected.view(2, 30))


@pytest.mark.parametrize("sign", [1, -1])
def test_log_residuals_end_at_15(sampler, sign, randn):
    torch.nn.init.constant_(sampler.last.bias, sign * 1e4)

    found = sampler.log_residuals(randn(2, 30, FEATURES, dtype=torch.float64))

    assert (found == sign * 15).all()


@pytest.mark.parametrize(
    ("m_max", "size"),
    [
        (512, 32),
        (32, 32),
        (20, 20),
    ],
)
def test_steps_of_training_choose_32_points_or_all_of_fewer(m_max, size):
    sampler = PoseSampler(m_max, feature_channels=(8, 6), head_channels=(5,))

    assert sampler.training_sizes() == (size,)


def test_log_residuals_have_gradients_for_all_weights(sampler, cloud):
    sampler.train()
    twice = cloud.expand(2, -1, -1)

    residuals = sampler(twice).log_residuals
    residuals.square().sum().backward()

    for weights in sampler.parameters():
        assert weights.grad is not None
    assert sampler.last.weight.grad.abs().sum() > 0


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"feature_channels": ()}, "feature_channels"),
        ({"head_channels": (0,)}, "head_channels"),
        ({"seed": 1.5}, "seed must be a whole number"),
    ],
)
def test_arguments_out_of_range_raise(arguments, named):
    with pytest.raises(UserError, match=named):
        PoseSampler(8, **arguments)
