import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
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

    sources, targets = together.points.chunk(2)
    for i in range(6):
        own_generator = generators(6)[i]
        alone = make(points[i : i + 1], [own_generator])
        source, target = alone.points
        assert torch.equal(alone.quaternion[0], together.quaternion[i])
        assert torch.equal(alone.translation[0], together.translation[i])
        assert_close(source, sources[i])
        assert_close(target, targets[i])


def rows_of(cloud, points):
    distance, row = torch.cdist(cloud.double(), points.double()).min(1)
    assert distance.max() < 1e-4
    return set(row.tolist())


def test_pairs_resample_draws_different_points(rng):
    points = clouds(rng, points=60)

    batch = pairs(resample=20)(points, generators(6))

    source, target = restored(batch)
    moved_points = moved(batch, points)
    assert source.shape == (6, 20, 3)
    assert target.shape == (6, 20, 3)
    for i in range(6):
        rows_of_source = rows_of(source[i], points[i])
        rows_of_target = rows_of(target[i], moved_points[i])
        assert len(rows_of_source) == 20
        assert len(rows_of_target) == 20
        assert rows_of_source != rows_of_target


def test_pairs_resample_of_all_points_has_every_point_in_another_order(rng):
    points = clouds(rng)

    batch = pairs(resample=50)(points, generators(6))

    source, _ = restored(batch)
    assert rows_of(source[3], points[3]) == set(range(50))
    assert not torch.allclose(source[3], points[3])


def test_pairs_turn_by_up_to_45_degrees_and_shift_by_up_to_one(randn):
    points = randn(1, 4, 3).expand(1000, -1, -1)

    batch = pairs()(points, generators(1000))

    rotation = Rotation.from_quat(batch.quaternion.numpy(), scalar_first=True)
    angles = np.abs(rotation.as_euler("xyz", degrees=True)).max(0)
    shifts = batch.translation.abs().amax(0)
    assert (angles < 45.001).all()
    assert (angles > 44).all()
    assert (shifts <= 1).all()
    assert (shifts > 0.98).all()


def test_pairs_resample_out_of_range_raises(rng):
    with pytest.raises(UserError, match=r"^resample must be .*got 0"):
        pairs(resample=0)
    with pytest.raises(UserError, match=r"^resample must be at most the 50 .*got 51"):
        pairs(resample=51)(clouds(rng), generators(6))
