"""Choose points that keep the pose: FMOPS-Net for registration, beside farthest points.

    python examples/06_registration.py

A PCRNet that ships with the package aligns pairs of clouds from the chosen points. Further
arguments are settings: trainer.max_epochs=5 'sizes=[8,16]'.
"""

import sys
from datetime import datetime
from pathlib import Path

from mops_lightning.config.compose import compose
from mops_lightning.training.run.run import run

settings = ["task=registration", "sampler=fmops", *sys.argv[1:]]
folder = Path("outputs") / f"{datetime.now():%Y-%m-%d_%H-%M-%S}"
record = run(compose(settings), folder, settings)

for size in record.config["sizes"]:
    errors = {}
    for name in ("completed", "fps"):
        errors[name] = record.metrics[f"test/m{size}/{name}/rotation_error_deg"]
    print(
        f"{size} points: {errors['completed']:.2f} degrees by FMOPS-Net, "
        f"{errors['fps']:.2f} by farthest points"
    )
print(f"Curves and clouds: tensorboard --logdir {folder}")
