import torch

from mops_lightning.nets.icp import ICP
from mops_lightning.ops.rigid import random_motion, rotation_angle
from mops_lightning.seeding import generator


def test_icp_small_motion_is_exact(rng):
    source = torch.randn(6, 80, 3, generator=rng)
    true = random_motion(5.0, 0.05, [generator(4, i) for i in range(6)])
    found = ICP()(source, true.apply(source))
    assert torch.rad2deg(rotation_angle(found.quaternion, true.quaternion)).max() < 1e-3
    torch.testing.assert_close(found.translation, true.translation, atol=1e-4, rtol=0)


def test_icp_of_coincident_points_is_finite():
    found = ICP()(torch.zeros(2, 5, 3), torch.ones(2, 5, 3))
    assert torch.isfinite(found.quaternion).all()
    torch.testing.assert_close(found.apply(torch.zeros(2, 1, 3)), torch.ones(2, 1, 3))
