import numpy as np
import torch

from mops_lightning.viz.task_results import (
    MAX_POINTS,
    ReconstructionResult,
    RegistrationResult,
    pair_grid,
    reconstruction_grid,
)


def test_pair_grid_rings_samples_but_not_full_clouds(rng):
    source, target = torch.rand(2, 2, 40, 3, generator=rng)
    sampled = RegistrationResult(source, source[:, :8], target[:, :8], [3.0, 4.0])
    full = RegistrationResult(source, source, target, [1.0, 2.0])
    figure = pair_grid(source, target, [30.0, 40.0], {"fps": sampled, "full": full}, ["a", "b"])
    assert [axes.get_title() for axes in figure.axes[:4]] == [
        "before (centred)",
        "by fps",
        "by full",
        "",
    ]
    assert [len(axes.collections) for axes in figure.axes] == [2, 4, 2, 2, 4, 2]
    assert figure.axes[3].texts[0].get_text() == "b, 40.0° apart"
    assert figure.axes[4].texts[0].get_text() == "rotation error 4.0°"


def test_reconstruction_grid_thins_large_clouds_only(rng):
    points = torch.rand(1, 2 * MAX_POINTS, 3, generator=rng)
    result = ReconstructionResult(points[:, :8], points[:, :100], [1.5])
    figure = reconstruction_grid(points, points, {"fps": result}, ["chair"])
    counts = [[len(np.asarray(c.get_offsets())) for c in axes.collections] for axes in figure.axes]
    assert counts == [[MAX_POINTS], [MAX_POINTS], [MAX_POINTS, 8], [100]]
    assert figure.axes[3].texts[0].get_text() == "NRE 1.50"
