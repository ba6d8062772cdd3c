"""Distances between what the task net makes of a sample and of the whole cloud."""

import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.tasks.classification import Classification
from mops_lightning.training.recipe.distillation import (
    FullClouds,
    feature_distance,
    full_predictions,
    pooled_features,
)
from tests.support.training import small_dataset


def test_feature_distance_is_relative_to_the_reference():
    found = torch.tensor([[1.0, 2.0], [0.0, 3.0]])
    reference = torch.tensor([[3.0, 4.0], [0.0, 3.0]])
    assert feature_distance(found, reference) == pytest.approx((8 / 25 + 0) / 2)


def test_pooled_features_are_maxima_over_points():
    net, points = PointNetVanilla(3).eval(), torch.randn(2, 7, 3)
    torch.testing.assert_close(net.from_pooled(pooled_features(net, points)), net(points))


def test_feature_distillation_of_net_without_point_features_raises():
    with pytest.raises(UserError, match=r"feature_distillation must be 0 .* got Linear"):
        pooled_features(torch.nn.Linear(3, 3), torch.randn(2, 7, 3))


CPU = torch.device("cpu")


def predictions(tmp_path, seed=0, clouds=None):
    torch.manual_seed(seed)
    task = Classification(PointNetVanilla(3), 3).eval()
    clouds = clouds or small_dataset().train
    with torch.no_grad():
        plain = task.net(clouds.points)
    return full_predictions(task, FullClouds(clouds, 7, tmp_path), CPU), plain


def test_full_predictions_are_those_of_the_net(tmp_path):
    found, plain = predictions(tmp_path)
    torch.testing.assert_close(found, plain)
    other, other_plain = predictions(tmp_path, seed=1)
    torch.testing.assert_close(other, other_plain)
    assert not torch.allclose(found, other)
    data = small_dataset()
    torch.testing.assert_close(*predictions(tmp_path, clouds=data.test))
    assert len(list(tmp_path.rglob("*.pt"))) == 3


def test_full_predictions_are_read_from_their_file(tmp_path):
    found, _ = predictions(tmp_path)
    (path,) = tmp_path.rglob("*.pt")
    torch.save(found + 1, path)
    torch.testing.assert_close(predictions(tmp_path)[0], found + 1)


def test_full_predictions_damaged_file_raises(tmp_path):
    predictions(tmp_path)
    (path,) = tmp_path.rglob("*.pt")
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(UserError, match="expected predictions"):
        predictions(tmp_path)
