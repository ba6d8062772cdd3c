"""One file: what is kept of it."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mops_lightning import downsample
from tests.support.cloud_files import contents
from tests.support.clouds import uniform_points
from tests.support.downsample import done, refused


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
    source = folder / "in" / "a.ply"
    target = tmp_path / "out.npz"

    out = done(source, target, "--method", *method, "--m", 20)

    assert "20 of 299 points (1 more without finite coordinates left out)" in out
    kept = contents(target)
    whole = contents(source)
    rows = kept.columns["label"].astype(int)
    assert len(set(rows)) == 20
    assert_array_equal(kept.points, whole.points[rows])


@pytest.mark.parametrize("method", ["fps", "random"])
def test_seed_of_a_method_is_that_of_python(method, tmp_path):
    points = uniform_points(90, 0)
    np.save(tmp_path / "in.npy", points)
    settings = ["--method", method, "--m", 7, "--seed", 3]

    done(tmp_path / "in.npy", tmp_path / "out.npy", *settings)

    expected, rows = downsample(points, 7, method, seed=3)
    _, other_rows = downsample(points, 7, method, seed=0)
    assert as_set(np.load(tmp_path / "out.npy")) == as_set(expected)
    assert set(rows.tolist()) != set(other_rows.tolist())


def as_set(points):
    return {tuple(point) for point in points}


def test_matched_and_completed_readouts_keep_rows(folder, tmp_path):
    source = folder / "in" / "a.ply"
    whole = contents(source).finite().points

    def sampled(readout):
        target = tmp_path / f"{readout}.npy"
        settings = ["--weights", folder, "--readout", readout, "--m", 30]
        done(source, target, *settings, "--coordinates-only")
        points = np.load(target)
        assert points.shape == (30, 3)
        return points

    generated = sampled("generated")
    matched = as_set(sampled("matched"))
    completed = as_set(sampled("completed"))

    all_points = as_set(whole)
    assert not as_set(generated) & all_points
    assert matched < completed <= all_points
    assert len(completed) == 30
    # Mapped back: among the points, not in the unit sphere.
    assert (generated > whole.min(0)).all()
    assert (generated < whole.max(0)).all()


@pytest.mark.parametrize("size", [1e200, 1e307])
def test_huge_coordinates_are_rejected(size, folder, tmp_path):
    source = tmp_path / "a.npy"
    out = tmp_path / "b.npy"
    points = 1 + 8 * uniform_points(90, 0)
    np.save(source, points * size)

    whole = refused(source, out, "--method", "fps", "--m", 4)
    by_chunks = refused(source, out, "--weights", folder, "--readout", "matched", "--chunk", 60)

    assert "too large" in whole
    assert "too large" in by_chunks


def test_tile_trained_sampler_of_many_sizes(folder, tmp_path):
    out = tmp_path / "a.npy"

    done(folder / "in" / "a.ply", out, "--weights", folder, "--tile", 64, "--m", 120)

    different = np.unique(np.load(out), axis=0)
    assert len(different) == 120
