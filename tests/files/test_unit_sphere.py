"""Clouds in the unit sphere."""

import numpy as np
import pytest

from tests.support.downsample import call


@pytest.mark.parametrize("size", [1e200, 1e307])
def test_huge_coordinates_are_rejected(size, folder, tmp_path):
    np.save(tmp_path / "a.npy", np.random.default_rng(0).uniform(1, 9, size=(90, 3)) * size)
    learned = ["--weights", folder, "--readout", "matched", "--chunk", 60]
    for settings in (["--method", "fps", "--m", 4], learned):
        status, _, err = call(tmp_path / "a.npy", tmp_path / "b.npy", *settings)
        assert status == 2
        assert "too large" in err
