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
    methods = [Untrained("fps"), scored]
    choices = [
        keep.Choice(16, name),
        keep.Choice(32, "fps"),
    ]

    keep.save(tmp_path / "best.safetensors", choices, methods, seed=3)
    sampler = load(tmp_path / "best")

    output = sampler(clouds, 16)
    expected = scored.rows(clouds, 16, seed=3)
    assert torch.equal(output.indices, expected)


def test_sizes_that_were_not_compared_take_the_form_of_farthest_points_kept_most_often(
    tmp_path, rng
):
    clouds = normalize_unit_sphere(torch.rand(2, 100, 3, generator=rng))
    methods = [Untrained("fps"), Untrained(FPS_FARTHEST)]
    choices = [
        keep.Choice(8, "fps"),
        keep.Choice(16, FPS_FARTHEST),
        keep.Choice(32, FPS_FARTHEST),
    ]

    keep.save(tmp_path / "best.safetensors", choices, methods, seed=3)
    sampler = load(tmp_path / "best")

    for m, method in ((8, methods[0]), (20, methods[1])):
        assert torch.equal(sampler(clouds, m).indices, method.rows(clouds, m, seed=3))


ACCURACY = MetricInfo("accuracy", unit="%", scale=100.0, higher_is_better=True)


def test_method_that_is_better_on_the_first_half_alone_is_rejected():
    scores = [
        # m, method, on the half for choosing, on the other half
        (16, "fps", 0.5, 0.5),
        (16, "random", 0.9, 0.4),
        (16, "voxel", 0.4, 0.4),
        (32, "fps", 0.5, 0.5),
        (32, "poisson", 0.9, 0.9),
        (32, "voxel", 0.4, 0.4),
    ]
    rows = []
    for draw in (0, 1):
        more = 0.001 * draw
        for m, name, choosing, checking in scores:
            rows.append((draw, "choosing", m, name, choosing + more))
            rows.append((draw, "checking", m, name, checking + more))
    frame = pd.DataFrame(rows, columns=["draw", "files", "m", "method", "score"])
    methods = [Untrained(name) for name in ("fps", "random", "voxel", "poisson")]

    few, many = keep.choose(frame, ACCURACY, methods)

    assert few.method == "fps"
    assert few.line == "16 points: fps; random was 10 percentage points worse on the other half"
    assert many.method == "poisson"
    assert many.line.endswith("40 percentage points better than FPS on the other half")


def test_rejected_method_is_replaced_by_the_better_farthest_points_of_the_first_half():
    scores = {
        "choosing": {"fps": 0.5, FPS_FARTHEST: 0.4, "random": 0.9},
        "checking": {"fps": 0.4, FPS_FARTHEST: 0.5, "random": 0.3},
    }
    rows = []
    for draw in (0, 1):
        for half, of_half in scores.items():
            for name, value in of_half.items():
                rows.append((draw, half, 16, name, value + 0.001 * draw))
    frame = pd.DataFrame(rows, columns=["draw", "files", "m", "method", "score"])
    methods = [Untrained(name) for name in scores["choosing"]]

    (choice,) = keep.choose(frame, ACCURACY, methods)

    assert (choice.method, choice.rejected) == ("fps", "random")
    assert choice.line == (
        "16 points: fps; random was 20 percentage points worse on the other half"
    )
