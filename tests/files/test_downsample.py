"""One file: what is kept of it."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from tests.support.cloud_files import contents
from tests.support.downsample import call, done, refused


@pytest.mark.parametrize(
    "method",
    [
        ["fps"],
        ["random"],
        ["voxel"],
        ["poisson"],
        ["serial"],
        ["normal_space"],
        ["covariance"],
        ["information"],
        ["steady"],
        ["fps", "--tile", 64],
        ["information", "--tile", 64],
    ],
)
def test_untrained_method_keeps_rows_of_the_file(method, folder, tmp_path):
    source, target = folder / "in" / "a.ply", tmp_path / "out.npz"
    out = done(source, target, "--method", *method, "--m", 20)
    assert "20 of 299 points (1 more without finite coordinates left out)" in out
    kept, whole = contents(target), contents(source)
    rows = kept.columns["label"].astype(int)
    assert len(set(rows)) == 20
    assert_array_equal(kept.points, whole.points[rows])


def test_matched_and_completed_readouts_keep_rows(folder, tmp_path):
    source = folder / "in" / "a.ply"
    whole = contents(source).points
    found = {}
    for readout in ("generated", "matched", "completed"):
        target = tmp_path / f"{readout}.npy"
        settings = ["--weights", folder, "--readout", readout, "--m", 30]
        assert call(source, target, *settings, "--coordinates-only")[0] == 0
        found[readout] = np.load(target)
        assert found[readout].shape == (30, 3)
    inside = {readout: {tuple(p) for p in points} for readout, points in found.items()}
    all_points = {tuple(p) for p in whole}
    assert not inside["generated"] & all_points
    assert inside["matched"] < inside["completed"] <= all_points
    assert len(inside["completed"]) == 30
    # Mapped back: among the points, not in the unit sphere.
    finite = whole[np.isfinite(whole).all(1)]
    assert (found["generated"] > finite.min(0)).all()
    assert (found["generated"] < finite.max(0)).all()


@pytest.mark.parametrize("size", [1e200, 1e307])
def test_huge_coordinates_are_rejected(size, folder, tmp_path):
    np.save(tmp_path / "a.npy", np.random.default_rng(0).uniform(1, 9, size=(90, 3)) * size)
    learned = ["--weights", folder, "--readout", "matched", "--chunk", 60]
    for settings in (["--method", "fps", "--m", 4], learned):
        assert "too large" in refused(tmp_path / "a.npy", tmp_path / "b.npy", *settings)


def test_tile_trained_sampler_of_many_sizes(folder, tmp_path):
    options = ["--weights", folder, "--tile", 64, "--m", 120]
    assert call(folder / "in" / "a.ply", tmp_path / "a.npy", *options)[0] == 0
    assert len(np.unique(np.load(tmp_path / "a.npy"), axis=0)) == 120
