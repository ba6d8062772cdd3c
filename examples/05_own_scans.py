"""Train a sampler on a folder of your own scans, and downsample one of them.

    python examples/05_own_scans.py FOLDER

Without a folder, ten rooms are made. Further arguments are settings: epochs.sampler=20 m=16.
"""

import sys
from datetime import datetime
from pathlib import Path

import numpy as np
import trimesh

from mops_lightning import downsample
from mops_lightning.config.compose import compose
from mops_lightning.training.run.run import run


def make_rooms(folder):
    random = np.random.default_rng(0)
    folder.mkdir(exist_ok=True)
    for number in range(10):
        walls = trimesh.creation.box(extents=random.uniform([3, 3, 2], [6, 6, 3]))
        pillar = trimesh.creation.cylinder(radius=random.uniform(0.2, 0.6), height=2.0)
        surface, _ = trimesh.sample.sample_surface(walls + pillar, 5000, seed=number)
        trimesh.PointCloud(surface).export(folder / f"room_{number}.ply")


arguments = sys.argv[1:]
if arguments and "=" not in arguments[0]:
    scans = Path(arguments.pop(0))
else:
    scans = Path("rooms")
    make_rooms(scans)

settings = ["experiment=own_scans", f"dataset.root={scans}", *arguments]
folder = Path("outputs") / f"{datetime.now():%Y-%m-%d_%H-%M-%S}"
record = run(compose(settings), folder, settings)

# The sampler was trained on neighbourhoods of 1,024 points: so many points are given to it.
path = next(scans.glob("*.ply"))
points = np.asarray(trimesh.load(path).vertices, dtype=np.float32)
near = np.argsort(np.linalg.norm(points - points[0], axis=1))[:1024]
sample, rows = downsample(points[near], record.config["m"], method=folder)
print(f"{len(near)} points of {path} to {len(sample)}, by the sampler in {folder}")
