"""The corrupted clouds of published tables, and how many points they have."""

import pytest
import torch

from mops_lightning.data.clouds import Clouds
from mops_lightning.data.corruptions import KINDS, corrupt

ROUNDED = {
    "density_down": (978, 899, 820, 741, 662),
    "density_up": (978, 899, 820, 741, 662),
    "cutout": (993, 961, 897, 833, 737),
    "drop_global": (793, 661, 529, 396, 264),
    "drop_local": (951, 846, 740, 634, 529),
    "add_global": (1068, 1078, 1089, 1099, 1110),
    "add_local": (1163, 1268, 1374, 1480, 1585),
    "background": (1080, 1083, 1087, 1092, 1110),
}
"""Points of 1,057, of which no kind takes or adds a whole number."""


@pytest.mark.parametrize("kind", ROUNDED)
def test_numbers_of_points_are_rounded_to_the_nearest(kind):
    points = torch.rand(1, 1057, 3, generator=torch.Generator().manual_seed(0))
    cloud = Clouds(points, torch.zeros(1, dtype=torch.long))

    sizes = []
    for severity in range(1, 6):
        corrupted = corrupt(cloud, f"{kind}-{severity}")
        sizes.append(corrupted.points.shape[1])

    assert tuple(sizes) == ROUNDED[kind]


PUBLISHED = {
    "jitter": ((0.0206, -0.0073, -0.0009), (0.1360, 0.1298, 0.1341)),
    "rotation": ((0.0284, -0.0064, -0.0003), (0.1305, 0.1324, 0.1344)),
    "scaling": ((0.0, 0.0, 0.0), (0.0688, 0.1461, 0.1603)),
    "shear": ((0.0, 0.0, 0.0), (0.1145, 0.1059, 0.1149)),
    "distortion": ((0.0, 0.0, 0.0), (0.1365, 0.1338, 0.1120)),
    "density_down": ((0.0275, 0.0088, -0.0408), (0.1449, 0.1327, 0.1386)),
    "density_up": ((0.0127, 0.0085, 0.0141), (0.1306, 0.1265, 0.1285)),
    "cutout": ((0.0192, 0.0001, -0.0004), (0.1322, 0.1262, 0.1400)),
    "drop_global": ((0.0202, 0.0180, -0.0162), (0.1295, 0.1253, 0.1376)),
    "drop_local": ((-0.0067, -0.0335, -0.0254), (0.1509, 0.1266, 0.1420)),
    "add_global": ((0.0228, -0.0070, -0.0016), (0.1383, 0.1306, 0.1358)),
    "add_local": ((0.0420, 0.0604, 0.0397), (0.1372, 0.1515, 0.1477)),
    "background": ((0.0247, 0.0004, -0.0043), (0.1429, 0.1351, 0.1444)),
}
"""Mean coordinates and their mean squares of three clouds at severity 3."""


@pytest.mark.parametrize("kind", KINDS)
def test_corrupted_clouds_are_those_of_published_tables(kind):
    random = torch.rand(3, 200, 3, generator=torch.Generator().manual_seed(3)) - 0.5
    radii = random.norm(dim=2).amax(1)
    three = Clouds(random / radii[:, None, None], torch.arange(3))

    points = corrupt(three, f"{kind}-3").points.double()

    means, squares = PUBLISHED[kind]
    assert points.mean((0, 1)).tolist() == pytest.approx(means, abs=1e-4)
    assert points.square().mean((0, 1)).tolist() == pytest.approx(squares, abs=1e-4)
