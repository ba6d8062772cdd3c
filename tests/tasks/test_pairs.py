import pytest
import torch
from torch.testing import assert_close

from mops_lightning.errors import UserError
from mops_lightning.nets.pcrnet import PCRNet
from mops_lightning.ops.rigid import Motion
from mops_lightning.seeding import generator
from mops_lightning.tasks.registration import Registration


def pairs(**settings):
    return Registration(PCRNet(feature_channels=(8, 8)), **settings).make_batch


def generators(number, key=0):
    return [generator(key, i) for i in range(number)]


def clouds(rng, number=6, points=50):
    return torch.randn(number, points, 3, generator=rng)


def restored(batch):
    return (batch.points + batch.centroids[:, None]).chunk(2)


def moved(batch, points):
    return Motion(batch.quaternion, batch.translation).apply(points)


def test_pairs_target_is_moved_source(rng):
    points = clouds(rng)
    batch = pairs()(points, generators(6))
    source, target = restored(batch)
    assert_close(source, points)
    assert_close(target, moved(batch, source), atol=1e-5, rtol=0)
    assert_close(batch.points.mean(1), torch.zeros(12, 3), atol=1e-6, rtol=0)
    assert not torch.allclose(target, source, atol=0.1)


def test_pairs_depend_on_own_generator_only(rng):
    points = clouds(rng)
    make = pairs(resample=20)
    together = make(points, generators(6))
    for i in range(6):
        alone = make(points[i : i + 1], generators(6)[i : i + 1])
        for name in ("quaternion", "translation"):
            assert torch.equal(getattr(alone, name)[0], getattr(together, name)[i])
        assert_close(alone.points[0], together.points[i])
        assert_close(alone.points[1], together.points[6 + i])


def rows_of(cloud, points):
    distance, row = torch.cdist(cloud.double(), points.double()).min(1)
    assert distance.max() < 1e-4
    return set(row.tolist())


def test_pairs_resample_draws_different_points(rng):
    points = clouds(rng, points=60)
    batch = pairs(resample=20)(points, generators(6))
    source, target = restored(batch)
    assert source.shape == target.shape == (6, 20, 3)
    for i in range(6):
        mine = rows_of(source[i], points[i])
        theirs = rows_of(target[i], moved(batch, points)[i])
        assert len(mine) == len(theirs) == 20
        assert mine != theirs


def test_pairs_resample_out_of_range_raises(rng):
    with pytest.raises(UserError, match=r"^resample must be .*got 0"):
        pairs(resample=0)
    with pytest.raises(UserError, match=r"^resample must be at most the 50 .*got 51"):
        pairs(resample=51)(clouds(rng), generators(6))
