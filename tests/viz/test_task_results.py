import numpy as np
import torch

from mops_lightning.viz.task_results import MAX_POINTS, ReconstructionResult, reconstruction_grid


def test_reconstruction_grid_thins_large_clouds_only(rng):
    points = torch.rand(1, 2 * MAX_POINTS, 3, generator=rng)
    result = ReconstructionResult(points[:, :8], points[:, :100], [1.5])
    figure = reconstruction_grid(points, points, {"fps": result}, ["chair"])
    counts = [[len(np.asarray(c.get_offsets())) for c in axes.collections] for axes in figure.axes]
    assert counts == [[MAX_POINTS], [MAX_POINTS], [MAX_POINTS, 8], [100]]
    assert figure.axes[3].texts[0].get_text() == "NRE 1.50"
