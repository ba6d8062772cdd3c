"""Random rigid motions."""

from mops_lightning.ops.rigid import Motion, random_motion
from mops_lightning.seeding import generator


def motion(seed: int, number: int = 5) -> Motion:
    """Return motions by up to 180 degrees and 2 units, one for each cloud of a batch."""
    generators = []
    for cloud in range(number):
        generators.append(generator(seed, cloud))
    return random_motion(180.0, 2.0, generators)
