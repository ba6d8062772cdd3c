"""The methods of a comparison, and how they are saved."""

import pandas as pd
import pytest
import torch

from mops_lightning import load
from mops_lightning.files.task_net import keep
from mops_lightning.files.task_net.methods import FPS_FARTHEST, Untrained
from mops_lightning.metrics.info import MetricInfo
from mops_lightning.ops.points import normalize_unit_sphere
from mops_lightning.zoo.names import UNTRAINED


@pytest.mark.parametrize("name", [*UNTRAINED, FPS_FARTHEST])
def test_saved_method_chooses_the_points_that_were_scored(name, tmp_path, rng):
    points = torch.rand(2, 100, 3, generator=rng)
    clouds = normalize_unit_sphere(points)
    scored = Untrained(name)
    choices = [
        keep.Choice(16, name),
        keep.Choice(32, "fps"),
    ]

    keep.save(tmp_path / "best.safetensors", choices, [Untrained("fps"), scored], seed=3)
    sampler = load(tmp_path / "best")

    output = sampler(clouds, 16)
    assert torch.equal(output.indices, scored.rows(clouds, 16, seed=3))


ACCURACY = MetricInfo("accuracy", unit="%", scale=100.0, higher_is_better=True)


def test_method_that_is_better_on_the_first_half_alone_is_rejected():
    rows = []
    better_on = {"random": ("choosing",), "voxel": (), "poisson": ("choosing", "checking")}
    for m, names in ((16, ("fps", "random", "voxel")), (32, ("fps", "poisson", "voxel"))):
        for files in ("choosing", "checking"):
            for draw in (0, 1):
                for name in names:
                    is_better = files in better_on.get(name, ())
                    score = 0.5 if name == "fps" else 0.4
                    if is_better:
                        score = 0.9
                    rows.append((draw, files, m, name, score + 0.001 * draw))
    frame = pd.DataFrame(rows, columns=["draw", "files", "m", "method", "score"])
    methods = [Untrained(name) for name in ("fps", "random", "voxel", "poisson")]

    few, many = keep.choose(frame, ACCURACY, methods)

    assert few.method == "fps"
    assert few.line == "16 points: fps; random was 10 percentage points worse on the other half"
    assert many.method == "poisson"
    assert many.line.endswith("40 percentage points better than FPS on the other half")
