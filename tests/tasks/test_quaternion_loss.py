import numpy as np
import torch
from scipy.spatial.transform import Rotation

from mops_lightning.ops.rigid import Motion, rotation_angle
from mops_lightning.tasks.registration import quaternion_distance, quaternion_loss


def quaternions(seed, number=50):
    drawn = Rotation.random(number, random_state=seed).as_quat()
    return torch.from_numpy(np.roll(drawn, 1, axis=1).copy())


def test_quaternion_distance_is_minimum_over_signs():
    a = quaternions(1)
    b = quaternions(2)
    plain = torch.minimum((a - b).norm(dim=1), (a + b).norm(dim=1)).mean()
    torch.testing.assert_close(quaternion_distance(a, b), plain)
    torch.testing.assert_close(quaternion_distance(-a, b), plain)
    angle = rotation_angle(a, b)
    torch.testing.assert_close(quaternion_distance(a, b), (2 * (angle / 4).sin()).mean())


def test_quaternion_distance_gradient_points_to_nearer_sign():
    true = quaternions(3)
    predicted = (-true + 1e-2).requires_grad_()
    (gradient,) = torch.autograd.grad(quaternion_distance(predicted, true), predicted)
    assert ((predicted - gradient + true).norm(dim=1) < (predicted + true).norm(dim=1)).all()
    same = true.clone().requires_grad_()
    assert torch.isfinite(torch.autograd.grad(quaternion_distance(same, true), same)[0]).all()


def test_registration_loss_is_zero_at_true_motion_only(rng):
    true = Motion(quaternions(1), torch.randn(50, 3, dtype=torch.float64, generator=rng))
    assert sum(quaternion_loss(true, true).values()) < 1e-12
    other = Motion(quaternions(2), true.translation)
    assert sum(quaternion_loss(other, true).values()) > 0.1
    shifted = Motion(true.quaternion, true.translation + 1)
    assert sum(quaternion_loss(shifted, true).values()) > 0.1


def test_registration_loss_terms_of_a_shift():
    true = Motion(quaternions(1), torch.zeros(50, 3))
    terms = quaternion_loss(true._replace(translation=torch.ones(50, 3)), true)
    assert list(terms) == ["quaternion", "translation"]
    torch.testing.assert_close(terms["translation"], torch.tensor(3.0).sqrt())
