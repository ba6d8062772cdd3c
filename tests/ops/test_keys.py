"""Keys by the compiled loops, and by plain forms."""

import numpy as np
import pytest
import torch

from mops_lightning.ops.keys import STEP, WORD, SeededOrder, are_finite, seeded_keys, unit_spheres
from mops_lightning.samplers.ordering import _keys_on_device, in_unit_sphere, point_hashes
from tests.support.clouds import cloud_of

KINDS = ["sphere", "grid", "copies", "one point", "offset", "tiny", "huge", "outlier"]


def scrambled(key):
    """The finalizer of SplitMix64."""
    key ^= key >> 30
    key = key * 0xBF58476D1CE4E5B9 % WORD
    key ^= key >> 27
    key = key * 0x94D049BB133111EB % WORD
    return key ^ key >> 31


def plain_keys(points, seed):
    """Give the hash of a point to its first copy, and hashes of this one to all later ones."""
    hashes = point_hashes(points, seed)
    rows = []
    for cloud in hashes.tolist():
        copies = dict.fromkeys(cloud, 0)
        keys = []
        for hash_of_point in cloud:
            copy = copies[hash_of_point]
            copies[hash_of_point] += 1
            key = hash_of_point % WORD
            if copy > 0:
                key = scrambled((key + copy * STEP) % WORD)
            keys.append(key)
        rows.append(keys)
    return np.array(rows, np.uint64).view(np.int64)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("number", [1, 9, 700])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_keys_equal_plain_form(kind, number, dtype, rng):
    points = cloud_of(kind, (2, number), dtype, rng)

    keys = seeded_keys(points.numpy(), SeededOrder(11))

    keys_in_torch = _keys_on_device(points, 11)
    assert np.array_equal(keys, plain_keys(points, 11))
    assert np.array_equal(keys, keys_in_torch)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("channels", [1, 3, 5])
def test_keys_in_the_unit_sphere_are_those_of_the_moved_cloud(kind, channels, rng):
    cloud = cloud_of(kind, (2, 400), torch.float64, rng)
    points = torch.cat([cloud, cloud], 2)[..., :channels]

    keys = seeded_keys(points.numpy(), SeededOrder(4, in_sphere=True))

    moved = in_unit_sphere(points).numpy()
    expected = seeded_keys(moved, SeededOrder(4))
    assert (keys == expected).all()


def test_unit_spheres_have_the_exact_mean_in_any_order(randn):
    points = randn(2, 5000, 3, dtype=torch.float64).numpy() + 1e6

    spheres = unit_spheres(points)
    spheres_of_reversed = unit_spheres(points[:, ::-1])

    centres = spheres[:, :3]
    radii = spheres[:, 3]
    assert (spheres_of_reversed == spheres).all()
    np.testing.assert_allclose(centres, points.mean(1), rtol=1e-14)
    from_centre = points - centres[:, None]
    farthest = np.linalg.norm(from_centre, axis=2).max(1)
    np.testing.assert_allclose(radii, farthest, rtol=1e-14)


def test_unit_sphere_of_equal_points_has_radius_1():
    equal = np.full((1, 4, 3), 0.5)

    (sphere,) = unit_spheres(equal)

    assert sphere.tolist() == [0.5, 0.5, 0.5, 1.0]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_are_finite_finds_one_bad_value(dtype):
    values = np.ones((3, 7), dtype)
    assert are_finite(values)
    assert are_finite(values[:0])
    for bad in (np.nan, np.inf, -np.inf, -np.nan):
        values[1, 4] = bad
        assert not are_finite(values)
