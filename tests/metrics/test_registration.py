import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mops_lightning.errors import UserError
from mops_lightning.metrics.registration import RotationError, RotationRecall, TranslationError
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


def test_rotation_errors_are_scipys_over_all_pairs():
    a, b = Rotation.random(40, random_state=1), Rotation.random(40, random_state=2)
    want = np.degrees((a.inv() * b).magnitude())
    given = motions(a), motions(b)
    assert in_batches(RotationError(), *given) == pytest.approx(want.mean(), abs=1e-4)
    assert in_batches(RotationError(factor=2.0), *given) == pytest.approx(2 * want.mean(), abs=1e-4)
    assert in_batches(RotationError(quantile=0.9), *given) == pytest.approx(
        np.quantile(want, 0.9), abs=1e-3
    )
    for limit in (60.0, 150.0):
        share = (want <= limit).mean()
        assert in_batches(RotationRecall(limit), *given) == pytest.approx(share)


def test_the_doubled_angle_is_the_formula_of_pcrnets_code():
    a, b = Rotation.random(40, random_state=1), Rotation.random(40, random_state=2)
    given = motions(a), motions(b)
    cosine = 2 * (given[0].quaternion * given[1].quaternion).sum(1).double() ** 2 - 1
    formula = torch.rad2deg(2 * torch.acos(cosine)).mean().item()
    assert in_batches(RotationError(factor=2.0), *given) == pytest.approx(formula, abs=1e-3)


def test_equal_rotations_score_zero_where_the_arc_cosine_gives_nan():
    same = motions(Rotation.random(5000, random_state=3))
    cosine = 2 * (same.quaternion * same.quaternion).sum(1) ** 2 - 1
    assert torch.acos(cosine).isnan().any()  # the trap
    assert RotationError()(same, same) < 1e-4
    assert RotationRecall(5.0)(same, same) == 1
    flipped = Motion(-same.quaternion, same.translation)
    assert RotationError()(flipped, same) < 1e-4


def test_half_turns_score_180():
    turns = Rotation.from_rotvec(np.pi * np.eye(3))
    still = Rotation.identity(3)
    assert RotationError()(motions(turns), motions(still)).item() == pytest.approx(180, abs=1e-3)


def test_translation_errors_are_distances():
    turn = Rotation.identity(2)
    predicted = motions(turn, torch.tensor([[3.0, 4, 0], [0, 0, 0]]))
    true = motions(turn, torch.tensor([[0.0, 0, 0], [0, 1, 0]]))
    assert TranslationError()(predicted, true).item() == pytest.approx(3.0)


def test_recall_counts_the_limit_itself():
    exact = motions(Rotation.from_euler("x", [[0.0], [90.0]], degrees=True))
    still = motions(Rotation.identity(2))
    assert RotationRecall(0.0)(exact, still) == 0.5


def test_reset_forgets():
    a, b = motions(Rotation.random(4, random_state=1)), motions(Rotation.random(4, random_state=2))
    metric = RotationError()
    metric.update(a, b)
    metric.reset()
    assert metric(a, a) < 1e-4


def test_a_quantile_out_of_range_is_refused():
    with pytest.raises(UserError, match=r"quantile must be between 0 and 1, got 90"):
        RotationError(quantile=90)
