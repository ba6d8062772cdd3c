"""The moving picture of the README."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

HOOKS = Path(__file__).parents[2] / "docs" / "hooks"


@pytest.fixture
def movie(monkeypatch):
    monkeypatch.syspath_prepend(HOOKS)
    sys.modules.pop("movie", None)
    import movie

    return movie


def test_movie_goes_from_grey_cloud_to_few_points_and_back_in_colour(movie, tmp_path):
    cloud = movie.read_cloud(0)
    sampled, prediction = movie.sample_and_classify(cloud)
    assert (cloud.shape, sampled.shape, prediction) == ((1024, 3), (32, 3), "chair, 100%")
    frames = movie.draw(cloud, sampled, prediction, still=1, moving=1)
    movie.write(frames, tmp_path / "a.gif")
    image: Any = Image.open(tmp_path / "a.gif")
    assert (image.n_frames, image.info["loop"]) == (8, 0)
    image.close()
    pixels = [np.asarray(frame.crop((0, 40, *frame.size)), float) for frame in frames]
    coloured = [float(np.ptp(array, axis=2).max()) > 100 for array in pixels]
    assert coloured == [False, False, True, True, True, True, True, True]
    drawn = [float((array < 250).any(2).mean()) for array in pixels]
    assert drawn[2] < drawn[0] / 2
    assert drawn[2] < drawn[-1] / 2
