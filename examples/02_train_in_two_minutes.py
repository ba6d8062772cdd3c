"""Train MOPS-Net for a classifier, on shapes that are generated: the main job, from Python.

    python examples/02_train_in_two_minutes.py

Every argument is a setting, as on the command line: m=16 sampler.alpha=10 trainer.max_epochs=20.
"""

import sys
from datetime import datetime
from pathlib import Path

import numpy as np

from mops_lightning import downsample
from mops_lightning.config.compose import compose
from mops_lightning.training.run.run import run

settings = sys.argv[1:]
folder = Path("outputs") / f"{datetime.now():%Y-%m-%d_%H-%M-%S}"

# A PointNet is trained first, once: it is kept in the cache.
record = run(compose(settings), folder, settings)

# The run's folder is a sampler by name.
m = record.config["m"]
cloud = np.random.default_rng(0).random((2000, 3), dtype=np.float32)
sample, rows = downsample(cloud, m, method=folder)

assert record.score is not None
print(f"{record.score:.2%} of the test shapes from {m} points, in {folder}")
