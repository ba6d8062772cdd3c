import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.nets.icp import ICP
from mops_lightning.ops.rigid import random_motion, rotation_angle
from mops_lightning.seeding import generator


def test_small_motions_of_the_same_points_are_found_exactly(rng):
    source = torch.randn(6, 80, 3, generator=rng)
    true = random_motion(5.0, 0.05, [generator(4, i) for i in range(6)])
    found = ICP(max_iterations=50, threshold=0.0)(source, true.apply(source))
    assert torch.rad2deg(rotation_angle(found.quaternion, true.quaternion)).max() < 1e-3
    torch.testing.assert_close(found.translation, true.translation, atol=1e-4, rtol=0)


def test_points_that_all_coincide_give_a_motion_all_the_same():
    found = ICP()(torch.zeros(2, 5, 3), torch.ones(2, 5, 3))
    assert torch.isfinite(found.quaternion).all()
    torch.testing.assert_close(found.apply(torch.zeros(2, 1, 3)), torch.ones(2, 1, 3))


def test_it_has_no_weights():
    assert not list(ICP().parameters())
    assert not ICP.differentiable


@pytest.mark.parametrize(("setting", "value"), [("max_iterations", 0), ("threshold", -1.0)])
def test_settings_out_of_range_are_refused(setting, value):
    with pytest.raises(UserError, match=rf"task.net.{setting} must .*got {value}"):
        ICP(**{setting: value})
