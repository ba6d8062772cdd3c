import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mops_lightning.metrics import registration
from mops_lightning.ops.rigid import Motion


def motions(rotation, translation=None):
    quaternion = torch.from_numpy(np.roll(rotation.as_quat(), 1, axis=1).copy()).float()
    if translation is None:
        translation = torch.zeros(len(quaternion), 3)
    return Motion(quaternion, translation)


def in_batches(metric, predicted, true):
    for i in range(0, len(true.quaternion), 7):
        batch = (Motion(*(part[i : i + 7] for part in both)) for both in (predicted, true))
        metric.update(*batch)
    return metric.compute().item()


def recall(limit):
    class Recall(registration.RotationRecall):
        degrees = limit

    return Recall()


def test_rotation_error_matches_scipy():
    a = Rotation.random(40, random_state=1)
    b = Rotation.random(40, random_state=2)
    want = np.degrees((a.inv() * b).magnitude())
    given = motions(a), motions(b)
    assert in_batches(registration.RotationError(), *given) == pytest.approx(want.mean(), abs=1e-4)
    doubled = in_batches(registration.DoubledRotationError(), *given)
    assert doubled == pytest.approx(2 * want.mean(), abs=1e-4)
    p90 = in_batches(registration.RotationErrorP90(), *given)
    assert p90 == pytest.approx(np.quantile(want, 0.9), abs=1e-3)
    for limit in (60.0, 150.0):
        share = (want <= limit).mean()
        assert in_batches(recall(limit), *given) == pytest.approx(share)


def test_equal_rotations_score_zero_despite_rounding():
    same = motions(Rotation.random(5000, random_state=3))
    cosine = 2 * (same.quaternion * same.quaternion).sum(1) ** 2 - 1
    assert torch.acos(cosine).isnan().any()  # what the formula would give
    assert registration.RotationError()(same, same) < 1e-4
    assert recall(5.0)(same, same) == 1
    flipped = Motion(-same.quaternion, same.translation)
    assert registration.RotationError()(flipped, same) < 1e-4


def test_translation_error_is_mean_distance():
    turn = Rotation.identity(2)
    predicted = motions(turn, torch.tensor([[3.0, 4, 0], [0, 0, 0]]))
    true = motions(turn, torch.tensor([[0.0, 0, 0], [0, 1, 0]]))
    assert registration.TranslationError()(predicted, true).item() == pytest.approx(3.0)


def test_recalls_include_limits_of_5_and_10_degrees():
    angles = [[4.9], [5.1], [9.9], [10.1]]
    turned = motions(Rotation.from_euler("x", angles, degrees=True))
    still = motions(Rotation.identity(4))
    assert registration.RotationRecall5()(turned, still) == 1 / 4
    assert registration.RotationRecall10()(turned, still) == 3 / 4
    exact = motions(Rotation.from_euler("x", [[0.0], [90.0]], degrees=True))
    assert recall(0.0)(exact, motions(Rotation.identity(2))) == 0.5
