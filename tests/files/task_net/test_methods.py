"""The methods of a comparison, and how they are saved."""

import pytest
import torch

from mops_lightning import load
from mops_lightning.files.task_net import keep
from mops_lightning.files.task_net.methods import FPS_FARTHEST, Untrained
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
