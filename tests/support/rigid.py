"""Random rigid motions."""

from mops_lightning.ops.rigid import random_motion
from mops_lightning.seeding import generator


def motion(seed, number=5):
    return random_motion(180.0, 2.0, [generator(seed, i) for i in range(number)])
