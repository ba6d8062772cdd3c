"""Train a classifier and a sampler on points with intensity and normals; downsample a scan.

    python examples/07_channels.py

Two kinds of road are made, of one shape: only their intensity tells painted from plain. Further
arguments are settings, such as dataset.features=null, which leaves x, y and z alone.
"""

import sys
from datetime import datetime
from pathlib import Path

import numpy as np

from mops_lightning import downsample, load
from mops_lightning.config.compose import compose
from mops_lightning.ops.normals import upward_normals
from mops_lightning.training.run.run import run


def make_roads(folder):
    random = np.random.default_rng(0)
    for kind in ("painted", "plain"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
        for number in range(20):
            points = random.uniform([-4, -2, 0], [4, 2, 0.05], (600, 3))
            intensity = random.normal(30, 10, len(points))
            if kind == "painted":
                intensity[abs(points[:, 1]) < 0.3] += 150  # a white line
            columns = np.column_stack([points, intensity]).astype(np.float32)
            np.save(folder / kind / f"{number}.npy", columns)


make_roads(Path("roads"))
settings = [
    "task=classification",
    "dataset=clouds",
    "dataset.root=roads",
    "dataset.crop=whole",
    "dataset.n_points=512",
    # A .npy file names its further columns column_3 and so on; other formats have names.
    "dataset.features=[column_3,normals]",
    "sampler=fmops",
    "sampler.m_max=32",
    "m=16",
    "batch_size=8",
    *sys.argv[1:],
]
folder = Path("outputs") / f"{datetime.now():%Y-%m-%d_%H-%M-%S}"
record = run(compose(settings), folder, settings)
print(f"{record.score:.0%} of the test roads right from 16 points")

# A model takes its channels after x, y and z, in the units of the files.
print("channels of the sampler:", ", ".join(load(folder).point_channels.names) or "none")
road = np.load("roads/painted/0.npy")
if load(folder).point_channels:
    road = np.hstack([road, upward_normals(road[:, :3].astype(float)).astype(np.float32)])
sample, rows = downsample(road, record.config["m"], method=folder)
painted = (sample[:, 3] > 100).mean()
print(f"{len(road)} points to {len(sample)}, {painted:.0%} of them on the line")
