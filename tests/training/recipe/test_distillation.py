"""Distances between what the task net makes of a sample and of the whole cloud."""

import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.training.recipe.distillation import feature_distance, pooled_features


def test_feature_distance_is_relative_to_the_reference():
    found = torch.tensor([[1.0, 2.0], [0.0, 3.0]])
    reference = torch.tensor([[3.0, 4.0], [0.0, 3.0]])
    assert feature_distance(found, reference) == pytest.approx((8 / 25 + 0) / 2)


def test_feature_distillation_of_net_without_point_features_raises():
    with pytest.raises(UserError, match=r"feature_distillation must be 0 .* got Linear"):
        pooled_features(torch.nn.Linear(3, 3), torch.randn(2, 7, 3))
