import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mops_lightning.metrics import registration
from mops_lightning.ops.rigid import Motion


def motions(rotation, translation=None):
    scalar_first = rotation.as_quat(scalar_first=True)
    quaternion = torch.from_numpy(scalar_first).float()
    if translation is None:
        translation = torch.zeros(len(quaternion), 3)
    return Motion(quaternion, translation)


def in_batches(metric, predicted, true):
    for start in range(0, len(true.quaternion), 7):
        rows = slice(start, start + 7)
        predicted_batch = rows_of(predicted, rows)
        true_batch = rows_of(true, rows)
        metric.update(predicted_batch, true_batch)
    return metric.compute().item()


def rows_of(motion, rows):
    return Motion(motion.quaternion[rows], motion.translation[rows])


def angles_between(predicted, true):
    """Return the angles of scipy's rotations, in degrees."""
    difference = predicted.inv() * true
    return np.degrees(difference.magnitude())


def recall(limit):
    class Recall(registration.RotationRecall):
        degrees = limit

    return Recall()


def test_rotation_errors_match_scipy():
    predicted = Rotation.random(40, random_state=1)
    true = Rotation.random(40, random_state=2)
    angles = angles_between(predicted, true)
    given = (motions(predicted), motions(true))

    mean = in_batches(registration.RotationError(), *given)
    doubled = in_batches(registration.DoubledRotationError(), *given)
    p90 = in_batches(registration.RotationErrorP90(), *given)

    assert mean == pytest.approx(angles.mean(), abs=1e-4)
    assert doubled == pytest.approx(2 * angles.mean(), abs=1e-4)
    assert p90 == pytest.approx(np.quantile(angles, 0.9), abs=1e-3)


@pytest.mark.parametrize("limit", [60.0, 150.0])
def test_recall_matches_scipy(limit):
    predicted = Rotation.random(40, random_state=1)
    true = Rotation.random(40, random_state=2)

    share = in_batches(recall(limit), motions(predicted), motions(true))

    angles = angles_between(predicted, true)
    assert share == pytest.approx((angles <= limit).mean())


def test_equal_rotations_score_zero_despite_rounding():
    same = motions(Rotation.random(5000, random_state=3))
    flipped = Motion(-same.quaternion, same.translation)
    error = registration.RotationError()

    error_of_same = error(same, same)
    error_of_flipped = error(flipped, same)

    product = (same.quaternion * same.quaternion).sum(1)
    cosine = 2 * product**2 - 1
    assert torch.acos(cosine).isnan().any()  # what the formula would give
    assert error_of_same < 1e-4
    assert error_of_flipped < 1e-4
    assert recall(5.0)(same, same) == 1


def test_translation_error_is_mean_distance():
    still = Rotation.identity(2)
    predicted = motions(still, torch.tensor([[3.0, 4.0, 0.0], [0.0, 0.0, 0.0]]))
    true = motions(still, torch.tensor([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))

    error = registration.TranslationError()(predicted, true)

    assert error.item() == pytest.approx((5 + 1) / 2)


def turned_about_x(*angles):
    return motions(Rotation.from_euler("x", np.array(angles)[:, None], degrees=True))


def test_recalls_include_limits_of_5_and_10_degrees():
    turned = turned_about_x(4.9, 5.1, 9.9, 10.1)
    still = motions(Rotation.identity(4))

    assert registration.RotationRecall5()(turned, still) == 1 / 4
    assert registration.RotationRecall10()(turned, still) == 3 / 4


def test_median_error_and_recall_of_2_degrees():
    turned = turned_about_x(1.9, 2.1, 30.0, 40.0, 50.0)
    still = motions(Rotation.identity(5))

    median = registration.MedianRotationError()(turned, still)
    recall = registration.RotationRecall2()(turned, still)

    assert median.item() == pytest.approx(30, abs=1e-3)
    assert recall.item() == pytest.approx(1 / 5)


def test_recall_includes_its_limit():
    turned = turned_about_x(0.0, 90.0)
    still = motions(Rotation.identity(2))

    assert recall(0.0)(turned, still) == 0.5
