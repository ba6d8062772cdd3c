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

    frames = movie.draw(cloud, sampled, prediction, still=1, moving=1)
    movie.write(frames, tmp_path / "a.gif")

    assert cloud.shape == (1024, 3)
    assert sampled.shape == (32, 3)
    assert prediction == "chair, 100%"
    image: Any = Image.open(tmp_path / "a.gif")
    assert image.n_frames == 8
    assert image.info["loop"] == 0
    image.close()
    coloured = [is_coloured(frame) for frame in frames]
    assert coloured == [False, False, True, True, True, True, True, True]
    of_cloud = share_drawn(frames[0])
    of_sample = share_drawn(frames[2])
    of_coloured_cloud = share_drawn(frames[-1])
    assert of_sample < of_cloud / 2
    assert of_sample < of_coloured_cloud / 2


def pixels_below_title(frame):
    width, height = frame.size
    return np.asarray(frame.crop((0, 40, width, height)), float)


def is_coloured(frame):
    """Return whether red, green and blue of any pixel are far apart."""
    spread = np.ptp(pixels_below_title(frame), axis=2)
    return bool(spread.max() > 100)


def share_drawn(frame):
    """Return the share of pixels that are not white."""
    is_drawn = (pixels_below_title(frame) < 250).any(axis=2)
    return float(is_drawn.mean())
