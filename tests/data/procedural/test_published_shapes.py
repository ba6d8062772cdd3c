"""Sides and parts of the shapes that published models were trained on."""

import numpy as np
import pytest

from mops_lightning.data.procedural import sampled
from mops_lightning.data.shapes import CLASSES

SIDES: dict[str, tuple[tuple[float, float, float], dict[str, int]]] = {
    "airplane": (
        (0.0015, 0.0006, -0.0071),
        {"engine": 169, "hull": 1181, "tail": 395, "wing": 815},
    ),
    "bed": (
        (-0.0017, 0.0071, 0.0330),
        {"board": 478, "frame": 676, "leg": 92, "mattress": 1134, "pillow": 180},
    ),
    "bottle": ((0.0002, 0.0290, 0.0009), {}),
    "bowl": ((0.0018, -0.0005, 0.0045), {}),
    "bucket": ((0.0029, -0.0039, -0.0052), {}),
    "chair": (
        (0.0006, -0.0040, 0.0138),
        {"arm": 103, "back": 799, "leg": 611, "seat": 1047},
    ),
    "cup": (
        (0.0024, 0.0100, 0.0014),
        {"handle": 183, "saucer": 361, "vessel": 2016},
    ),
    "desk": ((0.0075, -0.0076, 0.0007), {}),
    "goblet": ((-0.0003, -0.0461, 0.0007), {}),
    "lamp": (
        (0.0038, -0.0494, -0.0001),
        {"base": 1024, "pole": 446, "shade": 1090},
    ),
    "shelf": ((-0.0018, -0.0020, 0.0004), {}),
    "sofa": ((0.0003, 0.0068, 0.0217), {}),
    "stool": (
        (0.0006, -0.0262, 0.0009),
        {"leg": 1126, "seat": 1434},
    ),
    "table": (
        (-0.0007, -0.0256, -0.0002),
        {"leg": 996, "top": 1564},
    ),
    "teapot": (
        (-0.0047, 0.0095, 0.0014),
        {"handle": 196, "lid": 179, "spout": 280, "vessel": 1905},
    ),
    "vase": ((-0.0006, 0.0021, -0.0008), {}),
}
"""Mean cubes of x, y and z, and the points of every part, over twenty shapes of 128 points."""


@pytest.mark.parametrize("name", CLASSES)
def test_shapes_face_where_published_ones_do_and_have_their_parts(name):
    """Cubes tell a shape from its mirror image, and front from back, where distances do not."""
    shapes_of_class = [sampled.sampled_shape(name, 128, 0, 0, number) for number in range(20)]

    clouds = np.concatenate([cloud for cloud, _ in shapes_of_class]).astype(np.float64)
    parts = np.concatenate([names for _, names in shapes_of_class])
    cubes, numbers = SIDES[name]
    assert (clouds**3).mean(0) == pytest.approx(cubes, abs=1e-4)
    known, counts = np.unique(parts[parts != ""], return_counts=True)
    assert dict(zip(known.tolist(), counts.tolist(), strict=True)) == numbers
