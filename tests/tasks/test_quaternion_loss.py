import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from mops_lightning.ops.rigid import Motion, rotation_angle
from mops_lightning.tasks.registration import quaternion_distance, quaternion_loss


def quaternions(seed, number=50):
    drawn = Rotation.random(number, random_state=seed).as_quat()
    return torch.from_numpy(np.roll(drawn, 1, axis=1).copy())


def test_quaternion_distance_is_minimum_over_signs():
    a = quaternions(1)
    b = quaternions(2)

    distance = quaternion_distance(a, b)

    apart = (a - b).norm(dim=1)
    apart_with_other_sign = (a + b).norm(dim=1)
    nearer = torch.minimum(apart, apart_with_other_sign)
    assert_close(distance, nearer.mean())
    assert_close(quaternion_distance(-a, b), distance)
    chord = 2 * (rotation_angle(a, b) / 4).sin()
    assert_close(distance, chord.mean())


def test_quaternion_distance_gradient_points_to_nearer_sign():
    true = quaternions(3)
    predicted = (-true + 1e-2).requires_grad_()

    distance = quaternion_distance(predicted, true)
    (gradient,) = torch.autograd.grad(distance, predicted)

    before = (predicted + true).norm(dim=1)
    after = (predicted - gradient + true).norm(dim=1)
    assert (after < before).all()


def test_quaternion_distance_gradient_of_equal_quaternions_is_finite():
    true = quaternions(3)
    same = true.clone().requires_grad_()

    distance = quaternion_distance(same, true)
    (gradient,) = torch.autograd.grad(distance, same)

    assert torch.isfinite(gradient).all()


def test_registration_loss_is_zero_at_true_motion_only(randn):
    translation = randn(50, 3, dtype=torch.float64)
    true = Motion(quaternions(1), translation)
    turned = Motion(quaternions(2), translation)
    shifted = Motion(true.quaternion, translation + 1)

    of_true = quaternion_loss(true, true)
    of_turned = quaternion_loss(turned, true)
    of_shifted = quaternion_loss(shifted, true)

    assert sum(of_true.values()) < 1e-12
    assert sum(of_turned.values()) > 0.1
    assert sum(of_shifted.values()) > 0.1


def test_registration_loss_terms_of_a_shift():
    true = Motion(quaternions(1), torch.zeros(50, 3))
    terms = quaternion_loss(true._replace(translation=torch.ones(50, 3)), true)
    assert list(terms) == ["quaternion", "translation"]
    assert_close(terms["translation"], torch.tensor(3.0).sqrt())
