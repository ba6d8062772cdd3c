from pathlib import Path

import numpy as np
import pytest
import torch

from mops_lightning.downsample_files.cut import Tiling
from mops_lightning.downsample_files.large import in_turn
from mops_lightning.downsample_files.tiled import by_tiles, in_memory
from mops_lightning.errors import UserError
from mops_lightning.samplers.fmops import FMOPSNet
from mops_lightning.samplers.fps import FPSSampler

PATH = Path("scan.ply")


def street(number=4000):
    """A flat strip far from the origin, denser at one end."""
    random = np.random.default_rng(0)
    along = 40 * random.random(number) ** 2
    points = np.stack([along, 4 * random.random(number), 0.1 * random.random(number)], 1)
    return points + np.array([431_000, 5_412_000, 120])


@pytest.fixture(scope="module")
def sampler():
    torch.manual_seed(0)
    return FMOPSNet(64).eval()


def sample(points, sampler, m=200, tile=256, side=None, engine=in_turn, **options):
    tiling = Tiling(len(points), m, tile, side, points.min(0))
    return by_tiles(*in_memory(points, PATH), tiling, sampler, engine, **options)


@pytest.mark.parametrize(("tile", "side"), [(256, None), (None, 2.5)])
def test_by_tiles_returns_m_different_rows(tile, side, sampler):
    points = street()
    for one in (sampler, FPSSampler(10**6)):
        chosen, seams = sample(points, one, 201, tile, side)
        assert len(set(chosen.row.tolist())) == 201
        assert chosen.row.tolist() == sorted(chosen.row)
        np.testing.assert_array_equal(chosen.points, points[chosen.row])
        assert seams.after < seams.before / 4


def test_by_tiles_keeps_points_in_proportion():
    points = street()
    chosen, _ = sample(points, FPSSampler(10**6), 400)
    near = (points[:, 0] < 431_010).mean()
    assert abs((chosen.points[:, 0] < 431_010).mean() - near) < 0.03


def test_by_tiles_samples_a_tile_as_the_sampler_does(sampler):
    points = street(256)
    centred = points - points.mean(0)
    sphere = torch.from_numpy((centred / np.linalg.norm(centred, axis=1).max()).astype("f4"))
    rows = FPSSampler(40)(sphere[None]).indices[0]
    chosen, _ = sample(points, FPSSampler(40), 40)
    assert chosen.row.tolist() == rows.sort().values.tolist()


def test_by_tiles_order_of_parts_does_not_matter(sampler):
    points = street()
    tiling = Tiling(len(points), 300, 256, None, points.min(0))
    cloud, _ = in_memory(points, PATH)
    parts = cloud.row_ranges(1000)

    def backwards(title, function, cloud, parts, *common):
        return [function(cloud, rows, *common) for rows in reversed(parts)]

    first, seams = by_tiles(cloud, parts, tiling, sampler, in_turn)
    second, same = by_tiles(cloud, parts, tiling, sampler, backwards)
    assert seams == same
    np.testing.assert_array_equal(first.row, second.row)


def test_by_tiles_all_points_and_too_many(sampler):
    points = street(500)
    assert len(sample(points, sampler, 500, 60)[0].row) == 500
    with pytest.raises(UserError, match=r"tile of 250 points would keep 100.*up to 64"):
        sample(points, sampler, 200)
