import numpy as np
import pytest
import torch
from torch.testing import assert_close

from mops_lightning import PoseSampler
from mops_lightning.errors import UserError
from mops_lightning.ops.neighbourhoods import describe_neighbourhoods
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


def test_sample_equals_choice_by_predicted_residuals(sampler, cloud):
    output = sampler(cloud, 20)

    order = seeded_order(cloud, 0)[0].numpy()
    points = cloud[0].numpy()[order]
    described = describe_neighbourhoods(points)
    spread = np.exp(output.log_residuals[0].detach().numpy())[order]
    places = steady_places(plane_rows(points, described.normals), spread, 20)
    assert output.indices[0].tolist() == order[places].tolist()


def test_log_residuals_are_in_the_order_of_the_points(sampler, cloud):
    shuffled = torch.randperm(200, generator=torch.Generator().manual_seed(1))

    expected = sampler(cloud).log_residuals[:, shuffled]

    assert_close(sampler(cloud[:, shuffled]).log_residuals, expected)


def test_log_residuals_have_gradients_for_all_weights(sampler, cloud):
    sampler.train()
    sampler(cloud.expand(2, -1, -1)).log_residuals.square().sum().backward()

    assert all(weight.grad is not None for weight in sampler.parameters())
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
