"""Downsample a cloud of your own, and carry labels back to all of its points.

    python examples/01_downsample.py scan.ply --m 500

Without a file, a torus is made. The sample is saved beside the cloud, as NAME_small.ply.
"""

import argparse
from pathlib import Path

import numpy as np
import trimesh

from mops_lightning import downsample, propagate, propagation_map

parser = argparse.ArgumentParser()
parser.add_argument("cloud", nargs="?", type=Path)
parser.add_argument("--m", type=int, default=100)
arguments = parser.parse_args()

path = arguments.cloud or Path("torus.ply")
if arguments.cloud is None:
    torus = trimesh.creation.torus(major_radius=1.0, minor_radius=0.3)
    surface, _ = trimesh.sample.sample_surface(torus, 5000, seed=0)
    trimesh.PointCloud(surface).export(path)

points = np.asarray(trimesh.load(path).vertices, dtype=np.float32)

# Farthest points cover the cloud evenly. They suit any task.
sample, rows = downsample(points, arguments.m)
assert np.array_equal(sample, points[rows])

# A trained sampler chooses the points that its task net needs.
learned, _ = downsample(points, arguments.m, method="fmops.modelnet40-m512")

# Something is computed for the few points and carried back to all of them.
above = sample[:, 2] > points[:, 2].mean()
above_everywhere = propagate(above, propagation_map(points, sample, k=3))

place = path.with_name(f"{path.stem}_small.ply")
trimesh.PointCloud(sample).export(place)
share = above_everywhere.mean()
print(f"{len(points)} points to {len(sample)}, {share:.0%} of all above the middle: {place}")
